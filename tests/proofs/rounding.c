/* clang-format off */
/* A sum of n terms, none negative, each addition of which is rounded by a share U at most, is at least (1 - n U) of the exact
 * one; so a window whose last output took no more than what the rounded sum left is within the budget / (1 - n U). */
typedef double real;
/*@ axiomatic Rounding { logic real U; axiom small: 0 < U <= 1e-6; }
axiomatic Sums {
  logic real sum{L}(real *a, integer n) reads a[0 .. n - 1];
  axiom none{L}: \forall real *a; sum(a, 0) == 0.0;
  axiom last{L}: \forall real *a, integer n; 0 < n ==> sum(a, n) == sum(a, n - 1) + a[n - 1];
} */

/*@ requires a >= 0 && b >= 0; assigns \nothing; ensures \result >= 0 && \result >= (a + b) * (1 - U); */
real add(real a, real b); /* the assumption about the processor */
/*@ requires 0 <= x && 0 <= y; assigns \nothing; ensures x * y >= 0; */
static void product(real x, real y) { (void)x, (void)y; }
/*@ requires u == U && 0 <= k && k * U <= 1 && S >= 0 && a >= 0 && s >= (1 - k * U) * S; assigns \nothing;
    ensures (s + a) * (1 - U) >= (1 - (k + 1) * U) * (S + a); */
static void step(real k, real S, real a, real s, real u)
{
    product(s - (1 - k * u) * S, 1 - u);
    /*@ assert p1: (s - (1 - k * U) * S) * (1 - U) >= 0; */
    /*@ assert p2: k * U * U * S >= 0; */
    /*@ assert p3: k * U * a >= 0; */
    /*@ assert p4: (s + a) * (1 - U) - (1 - (k + 1) * U) * (S + a) == (s - (1 - k * U) * S) * (1 - U) + k * U * U * S + k * U * a; */
}

/*@ requires u == U && 0 <= n <= 100000000 && n * U <= 1 && \valid_read(a + (0 .. n - 1)) && \forall integer k; 0 <= k < n ==> a[k] >= 0;
    assigns \nothing; ensures \result >= (1 - n * U) * sum(a, n); */
real added(const real *a, int n, real u)
{
    real s = 0;
    real S = 0; /* exact: over real numbers */
    /*@ loop invariant 0 <= k <= n && S == sum(a, k) && S >= 0 && s >= 0 && s >= (1 - k * U) * S;
        loop assigns k, s, S; loop variant n - k; */
    for (int k = 0; k < n; k++) {
        step(k, S, a[k], s, u);
        s = add(s, a[k]);
        S += a[k];
    }
    return s;
}

/* The window: W before, W_ as computed, v the new energy. */
/*@ requires u == U && 0 <= n && n * U <= 0.5 && 0 <= W && W_ >= (1 - n * U) * W && 0 <= v && 0 <= budget - W_ && v <= (budget - W_) * (1 + U);
    requires 0 <= budget <= 1 && n >= 2;
    assigns \nothing; ensures (W + v) * (1 - n * U) <= budget; */
void window(real n, real W, real W_, real v, real budget, real u)
{
    product((budget - W_) * (1 + u) - v, 1 - n * u);
    /*@ assert q0: (1 + u) * (1 - n * u) <= 1; */
    product(budget - W_, 1 - (1 + u) * (1 - n * u));
    /*@ assert q1: v * (1 - n * U) <= (budget - W_) * (1 + U) * (1 - n * U); */
    /*@ assert q2: (1 + U) * (1 - n * U) <= 1; */
    /*@ assert q3: (budget - W_) * ((1 + U) * (1 - n * U)) <= budget - W_; */
}
