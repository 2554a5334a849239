/* KF-PB: a posterior of the plant, the control filter of least expected error, and one price of
 * power a loudspeaker.
 *
 *     y = v * x            asked of the loudspeakers
 *     e = p * x - s * y    heard by the microphones, and noise
 *
 * After every block of B samples, the posterior of p and s takes the block (posterior.c). Then the
 * filter of each loudspeaker in turn becomes the one of least expected error at the price of its
 * power, (A + price R) v = b: A is the correlation of its filtered references, R that of the
 * references, b theirs with what the others leave of the disturbance. N = L + M - 1 taps of a
 * primary path are all that control can reach; `lags` is L + N. C_ab(l) = E[a(t) b(t - l)]. */
#include "posterior.h"

enum { RATED_POWER, BLOCK, AVERAGING, WINDOW, MEMORY, SPREAD };
static const anc_setting budget_settings[] = {{"rated_power", 1e-30f, 0, ANC_EACH_LOUDSPEAKER},
                                              {"block", 1, 65536, ANC_ONE},
                                              {"averaging", 20, 100000, ANC_ONE},
                                              {"window", 0, 1, ANC_ONE},
                                              {"memory", 0, 1, ANC_ONE},
                                              {"spread", 0, 1000, ANC_ONE},
                                              {0}};

/* What is left of the account makes power cheaper by this many times its share, so that steady
 * noises spend all of it; at the cheapest, the price is this part of itself, so that a noise that
 * has become loud does not spend at once what it needs for long. */
static const real CHEAPER = 4, CHEAPEST = (real)0.7;
/* A rating of power must save at least this share of the noise. */
static const real WORTHWHILE = 0.5f;
/* Of the power that a price is to yield. */
static const real NEAR = (real)0.005;
/* Shares of the account: what a filter may always spend; what is never exceeded, but clipped. */
static const real LEAST_SHARE = (real)0.02, MOST = (real)1.04;
/* The account must afford the power of the last window of x for this part of the averaging time,
 * and that of the last block for this one. */
enum { WINDOW_LASTS = 4, BLOCK_LASTS = 20 };
/* The level of x is that of an exponential window which is so much shorter than that of its
 * spectrum: a spectrum needs many samples, a level few. */
enum { SHORTER = 5 };
/* A sound does not grow by more than this from one sample to the next, but a click in a reference
 * does. */
static const real GROWTH = 10;
enum { NEWTON = 20 }; /* steps */
/* No filter has a larger tap. REGULAR: share of the diagonal that is added to it, so that rounding
 * leaves the matrix definite. */
#ifdef ANC_FLOAT
static const real LARGEST_TAP = 1e6f, REGULAR = 1e-5f, LEAST_POWER = 1e-30f;
#else
static const real LARGEST_TAP = 1e50, REGULAR = 1e-7, LEAST_POWER = 1e-300;
#endif

typedef struct {
    signals s;
    posterior posterior;
    int32_t T, lags;       /* T: blocks of the account */
    real *asked;           /* (3, J) now; sum of squares of the block; the most it may become */
    real *peak;            /* (I) largest magnitude of x of late */
    int32_t *controlled;   /* whether control was on in the block */
    real *R, *short_R;     /* (I, I, lags), (I, I, L) windowed sums of x_i(t) x_a(t - l) */
    real *weight;          /* (2) of these windows */
    real *book;            /* (T, J) power of each block over the rating, newest first */
    real *price, *steady;  /* (J); (J) the price that spends the rating */
    real *C;               /* (I, I, 2 lags - 1) of the references, both signs of l */
    real *A;               /* (J, I, J, I, 2L - 1) of the filtered references */
    real *b;               /* (J, I, L) of these with d */
    real *sums;            /* (I, I, 2L - 1) A + price R of one loudspeaker */
    real *predictors;      /* (L rows of I, I, 1 to L) see `factorise` */
    real *forward, *small; /* (I, I, L), (L + 6, I, I) see `factorise` */
    real *vectors;         /* (VECTORS_OF_TAPS, I, L) */
    real *work;            /* (WORKS, width) */
    int32_t width;
} budget;
typedef char budget_fits_into_a_view[sizeof(budget) <= sizeof(anc_view) ? 1 : -1];

enum { REST, SOLUTION, PLAYED, VECTORS_OF_TAPS };
enum { WORKS = 3 };

/* Layout. */

/* Return whether the algorithm takes the plan, so that all products of counts below fit into an
 * int32. */
static int takes(const anc_plan *p, real block, real averaging)
{
    const double most = 1 << 28, B = block, T = averaging;
    const double K = p->microphones, J = p->loudspeakers, I = p->references;
    const double L = p->taps, M = p->path_taps, N = L + M - 1, n = I * N + J * M;
    if (p->guard_taps || p->scenarios != 1) return 0;
    if (!(B >= 1 && B <= 65536 && T >= 20 && T <= 100000 && n <= 1 << 14)) return 0;
    return K * n <= most && J * T <= most && J * J * I * I * 2 * L <= most &&
           (I + J + K) * (2 * L + M + B) <= most && I * I * L * L <= most &&
           I * I * 5 * (L + N) <= most && K * J * M <= most && J * J * 2 * M <= most &&
           I * J * 2 * N <= most;
}

static void layout_budget(anc_view *view, const anc_plan *plan, anc_layout *at)
{
    budget *f = (budget *)view;
    signals *s = &f->s;
    const int32_t J = plan->loudspeakers;
    const real *own = plan->settings ? plan->settings + J : NULL; /* after the rated powers */
    const real block = own ? own[BLOCK - 1] : 1,
               averaging = own ? own[AVERAGING - 1] : (real)BLOCK_LASTS;
    if (!takes(plan, block, averaging)) {
        at->size = SIZE_MAX;
        return;
    }
    layout_posterior(&f->posterior, s, (int32_t)block, !own || own[SPREAD - 1] == 0, at);
    const int32_t I = s->I, L = s->L, N = f->posterior.N, lags = L + N;
    f->T = (int32_t)averaging;
    f->lags = lags;
    f->width = 2 * lags + f->posterior.B;
    f->asked = reals(at, "asked", ANC_STATE, 1, 1, 3, J);
    f->peak = reals(at, "reference_peak", ANC_STATE, 1, 1, 1, I);
    f->controlled = int32s(at, "controlled", ANC_STATE, 1);
    f->R = reals(at, "reference_correlation", ANC_STATE, 1, I, I, lags);
    f->short_R = reals(at, "short_correlation", ANC_STATE, 1, I, I, L);
    f->weight = reals(at, "window_weights", ANC_STATE, 1, 1, 1, 2);
    f->book = reals(at, "book", ANC_STATE, 1, 1, f->T, J);
    f->price = reals(at, "price", ANC_STATE, 1, 1, 1, J);
    f->steady = reals(at, "steady_price", ANC_STATE, 1, 1, 1, J);
    f->C = reals(at, "two_sided", ANC_SCRATCH, 1, I, I, 2 * lags - 1);
    f->A = reals(at, "filtered_correlation", ANC_SCRATCH, J * I, J, I, 2 * L - 1);
    f->b = reals(at, "with_disturbance", ANC_SCRATCH, 1, J, I, L);
    f->sums = reals(at, "priced", ANC_SCRATCH, 1, I, I, 2 * L - 1);
    f->predictors = reals(at, "predictors", ANC_SCRATCH, I, I, L + 1, (L + 1) / 2);
    f->forward = reals(at, "forward_predictor", ANC_SCRATCH, 1, I, I, L);
    f->small = reals(at, "small_matrices", ANC_SCRATCH, 1, L + 6, I, I);
    f->vectors = reals(at, "vectors", ANC_SCRATCH, 1, VECTORS_OF_TAPS, I, L);
    f->work = reals(at, "budget_work", ANC_SCRATCH, 1, 1, WORKS, f->width);
}

/* Return what loudspeaker j has spent in the newest n blocks, in blocks of the rating. */
static real spent_by(const budget *f, int32_t j, int32_t n)
{
    real spent = 0;
    for (int32_t t = 0; t < n; t++) spent += f->book[times(t, f->s.J) + (size_t)j];
    return spent;
}

/* Set what each loudspeaker may spend in the next block, whatever its filter asks for. */
static void set_room(budget *f)
{
    const int32_t J = f->s.J;
    for (int32_t j = 0; j < J; j++) {
        const real left = larger(MOST * (real)f->T - spent_by(f, j, f->T), 0);
        f->asked[2 * J + j] = left * (real)f->posterior.B * f->s.setting[RATED_POWER][j];
    }
}

static void start_budget(anc_view *view)
{
    budget *f = (budget *)view;
    start_posterior(&f->posterior, *f->s.setting[SPREAD]);
    for (size_t n = 0; n < times(f->T, f->s.J); n++) f->book[n] = 1; /* spent before the start */
    set_room(f);
}

static real *work_row(const budget *f, int32_t row) { return f->work + times(row, f->width); }
static real *taps_of(const budget *f, int32_t number)
{
    return f->vectors + times(number, f->s.I * f->s.L);
}

/* Toeplitz systems. The blocks of a matrix are given by their lags, (I, I, 2L - 1) at some stride:
 * T(l)_ic, l from 1 - L up, is the block m - l = that lag to the right of the diagonal. T(-l) =
 * T(l)'. */

typedef struct {
    budget *f;
    const real *A, *R; /* at lag 1 - L of their first elements */
    size_t next_A, row_A, next_R, row_R;
    const real *b; /* (I, L) */
    real scale;
} toeplitz_system;

/* Set to_i = sum_c T_ic v_c. */
static void multiply_toeplitz(const budget *f, real *to, const real *T, size_t row, size_t next,
                              const real *v)
{
    const int32_t I = f->s.I, L = f->s.L;
    real *part = work_row(f, 0);
    clear(to, times(I, L));
    for (int32_t i = 0; i < I; i++)
        for (int32_t c = 0; c < I; c++) {
            real *restrict sums = to + times(i, L);
            /* from the last tap to the first */
            correlate(part, v + times(c, L), L, T + row * (size_t)i + next * (size_t)c, L);
            for (int32_t l = 0; l < L; l++) sums[l] += part[L - 1 - l];
        }
}

/* Factorise the lower triangle of a small matrix, I by I, in place, with the inverse of the
 * diagonal in its place. Return 0 if it is not positive definite. */
static int factorise_small(real *C, int32_t I)
{
    for (int32_t i = 0; i < I; i++)
        for (int32_t c = 0; c <= i; c++) {
            real sum = C[i * I + c];
            for (int32_t k = 0; k < c; k++) sum -= C[i * I + k] * C[c * I + k];
            if (c == i && !(sum > 0 && isfinite(sum))) return 0;
            C[i * I + c] = c < i ? sum * C[c * I + c] : 1 / root(sum);
        }
    return 1;
}

/* Solve C z = z; then C' z = z. */
static void forward_small(const real *C, real *z, int32_t I, int32_t stride)
{
    for (int32_t i = 0; i < I; i++) {
        for (int32_t k = 0; k < i; k++) z[i * stride] -= C[i * I + k] * z[k * stride];
        z[i * stride] *= C[i * I + i];
    }
}

static void backward_small(const real *C, real *z, int32_t I, int32_t stride)
{
    for (int32_t i = I - 1; i >= 0; i--) {
        for (int32_t k = i + 1; k < I; k++) z[i * stride] -= C[k * I + i] * z[k * stride];
        z[i * stride] *= C[i * I + i];
    }
}

/* Solve C C' z = z for a column of a matrix. */
static void solve_small(const real *C, real *z, int32_t I)
{
    forward_small(C, z, I, I);
    backward_small(C, z, I, I);
}

/* The backward predictor B of order m, (I, I, m + 1). */
static real *predictor_of(const budget *f, int32_t m)
{
    return f->predictors + times(f->s.I, f->s.I) * (times(m, m + 1) / 2);
}

static real *factor_of(const budget *f, int32_t m) { return f->small + times(m, f->s.I * f->s.I); }

/* Set the sums to T = A + price R, and start Whittle's recursion with order 0. */
static void start_recursion(const toeplitz_system *t, real price, real *D, real *E)
{
    const budget *f = t->f;
    const int32_t I = f->s.I, L = f->s.L, lags = 2 * L - 1;
    for (int32_t i = 0; i < I; i++)
        for (int32_t c = 0; c < I; c++) {
            const real *A = t->A + t->row_A * (size_t)i + t->next_A * (size_t)c;
            const real *R = t->R + t->row_R * (size_t)i + t->next_R * (size_t)c;
            real *restrict T = f->sums + times(i * I + c, lags);
            for (int32_t l = 0; l < lags; l++) T[l] = A[l] + price * R[l];
            if (i == c) T[L - 1] = A[L - 1] * (1 + REGULAR) + price * R[L - 1];
            /* A reference that is silent, or that nobody hears: its filter is zero. */
            if (i == c && T[L - 1] == 0) T[L - 1] = 1;
            D[i * I + c] = E[i * I + c] = T[L - 1];
            f->forward[times(i * I + c, L)] = i == c;
            predictor_of(f, 0)[i * I + c] = i == c;
        }
}

/* Factorise T = A + price R by Whittle's recursion; return 0 if it is not positive definite.
 *
 * For the first m + 1 blocks T_m of T: T_m B_m = [0, ..., 0, E], T_m F = [D, 0, ..., 0], where the
 * last block of B_m and the first of F are 1. So T^-1 = sum_m B_m E_m^-1 B_m'. With Delta = sum_k
 * T(k - m - 1) F_k: F  = [F, 0] - [0, B] E^-1 Delta      D = D - Delta' E^-1 Delta B  = [0, B] -
 * [F, 0] D^-1 Delta'     E = E - Delta D^-1 Delta' */
static int factorise(const toeplitz_system *t, real price)
{
    const budget *f = t->f;
    const int32_t I = f->s.I, L = f->s.L, lags = 2 * L - 1, square = I * I;
    real *D = factor_of(f, L), *E = D + square, *Delta = E + square;
    real *P = Delta + square, *Q = P + square; /* E^-1 Delta, D^-1 Delta' */
    real *F = f->forward, *B = predictor_of(f, 0);
    start_recursion(t, price, D, E);
    for (int32_t m = 0;; m++) {
        real *C = factor_of(f, m), *next = predictor_of(f, m + 1);
        copy(C, E, (size_t)square);
        if (!factorise_small(C, I)) return 0;
        if (m == L - 1) return 1;
        for (int32_t i = 0; i < I; i++)
            for (int32_t c = 0; c < I; c++) {
                real sum = 0;
                for (int32_t k = 0; k < I; k++) {
                    const real *T = f->sums + times(i * I + k, lags) + (L - 2 - m);
                    sum += dot(T, F + times(k * I + c, L), m + 1);
                }
                Delta[i * I + c] = P[i * I + c] = Q[c * I + i] = sum;
            }
        for (int32_t c = 0; c < I; c++) solve_small(C, P + c, I);
        real *of_D = factor_of(f, L + 5);
        copy(of_D, D, (size_t)square);
        if (!factorise_small(of_D, I)) return 0;
        for (int32_t c = 0; c < I; c++) solve_small(of_D, Q + c, I);
        for (int32_t i = 0; i < I; i++)
            for (int32_t c = 0; c < I; c++) {
                real *restrict to = next + times(i * I + c, m + 2);
                to[0] = 0;
                copy(to + 1, B + times(i * I + c, m + 1), (size_t)(m + 1));
                for (int32_t k = 0; k < I; k++) {
                    add_scaled(to, -Q[k * I + c], F + times(i * I + k, L), m + 1);
                    E[i * I + c] -= Delta[i * I + k] * Q[k * I + c];
                    D[i * I + c] -= Delta[k * I + i] * P[k * I + c];
                }
            }
        for (int32_t i = 0; i < I; i++)
            for (int32_t c = 0; c < I; c++) {
                real *to = F + times(i * I + c, L);
                to[m + 1] = 0;
                for (int32_t k = 0; k < I; k++)
                    add_scaled(to + 1, -P[k * I + c], B + times(i * I + k, m + 1), m + 1);
            }
        B = next;
    }
}

/* Set v to T^-1 u; return u'T^-1 u. */
static real solve_factorised(const budget *f, const real *u, real *v)
{
    const int32_t I = f->s.I, L = f->s.L;
    real *z = factor_of(f, L), energy = 0;
    if (v) clear(v, times(I, L));
    for (int32_t m = 0; m < L; m++) {
        const real *B = predictor_of(f, m), *C = factor_of(f, m);
        for (int32_t c = 0; c < I; c++) {
            z[c] = 0;
            for (int32_t i = 0; i < I; i++)
                z[c] += dot(B + times(i * I + c, m + 1), u + times(i, L), m + 1);
        }
        forward_small(C, z, I, 1);
        for (int32_t c = 0; c < I; c++) energy += z[c] * z[c];
        if (!v) continue;
        backward_small(C, z, I, 1);
        for (int32_t i = 0; i < I; i++)
            for (int32_t c = 0; c < I; c++)
                add_scaled(v + times(i, L), z[c], B + times(i * I + c, m + 1), m + 1);
    }
    return energy;
}

/* Set v to the filter at a price, u to R v, and return its power; 0 and no filter if there is no
 * solution. */
static real power_at(const toeplitz_system *t, real price, real *v, real *u, int *solved)
{
    const budget *f = t->f;
    const int32_t n = f->s.I * f->s.L;
    *solved = factorise(t, price);
    if (*solved) {
        solve_factorised(f, t->b, v);
        for (int32_t i = 0; i < n; i++) *solved = *solved && within(v[i], LARGEST_TAP);
    }
    if (!*solved) {
        clear(v, (size_t)n);
        return 0;
    }
    multiply_toeplitz(f, u, t->R, t->row_R, t->next_R, v);
    return dot(v, u, n);
}

/* Return the least price >= 0 at which the filter takes at most `power`; set v to it. power^-1/2 is
 * a concave function of the price, nearly a line, so Newton's steps approach from below. */
static real price_of(const toeplitz_system *t, real power, real start, real *v)
{
    real price = start < (real)1e6 * t->scale ? start : 0;
    real *u = taps_of(t->f, PLAYED);
    int solved = 0;
    for (int n = 0; n < NEWTON; n++) {
        const real taken = power_at(t, price, v, u, &solved);
        if (!solved) {
            const real least = (real)1e-6 * t->scale;
            price = 2 * price < least ? least : 2 * price;
            continue;
        }
        const real away = taken - power;
        if (within(away, NEAR * power) || (price == 0 && taken <= power)) break;
        const real slope = solve_factorised(t->f, u, NULL);
        if (!(slope > 0)) break;
        /* power^-1/2 has the slope taken^-3/2 u' T^-1 u */
        price = larger(price + taken * (root(taken / power) - 1) / slope, 0);
    }
    return price;
}

/* The references. */

/* The factor of the short window, a sample. */
static real short_window(const budget *f) { return raised(*f->s.setting[WINDOW], SHORTER); }

/* Add the block to a window of the references, (I, I, lags), and to its weight; x is zero before
 * the first, so the sums are positive definite. */
static void take_references(const budget *f, real *sums, int32_t lags, real g, real *weight)
{
    const int32_t I = f->s.I, B = f->posterior.B;
    const real fade = raised(g, B);
    real *windowed = work_row(f, 0), *more = work_row(f, 1);
    for (int32_t i = 0; i < I; i++) {
        const real *u = history_of(&f->posterior, i);
        real share = 1, all = 0;
        for (int32_t t = 0; t < B; t++) {
            windowed[t] = share * u[t];
            all += share;
            share *= g;
        }
        for (int32_t a = 0; a < I; a++) {
            real *restrict R = sums + times(i * I + a, lags);
            correlate(more, windowed, B, history_of(&f->posterior, a), lags);
            for (int32_t l = 0; l < lags; l++) R[l] = faded(R[l], fade, more[l]);
        }
        if (i == 0) *weight = fade * *weight + all;
    }
}

/* Set C to the correlations of the references at both signs of l, tapered. */
static void correlate_references(budget *f)
{
    const int32_t I = f->s.I, lags = f->lags;
    const real g = root(*f->s.setting[WINDOW]), weight = *f->weight;
    for (int32_t i = 0; i < I; i++)
        for (int32_t a = 0; a < I; a++) {
            const real *R = f->R + times(i * I + a, lags), *other = f->R + times(a * I + i, lags);
            real *C = f->C + times(i * I + a, 2 * lags - 1) + (lags - 1), taper = 1;
            for (int32_t l = 0; l < lags; l++) {
                C[l] = R[l] / weight * taper;
                C[-l] = other[l] / weight * taper;
                taper *= g;
            }
        }
}

/* The account. */

/* Return the mean power of the filter v in the present block. */
static real power_of_block(const budget *f, const real *v)
{
    const int32_t L = f->s.L, B = f->posterior.B;
    real *y = work_row(f, 0), *part = work_row(f, 1);
    clear(y, (size_t)B);
    for (int32_t i = 0; i < f->s.I; i++) {
        correlate(part, v + times(i, L), L, history_of(&f->posterior, i), B);
        add_to(y, part, B);
    }
    return dot(y, y, B) / (real)B;
}

/* Return the mean power of the filter v over the short window:
 * E[y^2] = sum_l (v_i ~ v_a)(l) C_ia(l), with both signs of l in the two orders of i and a. */
static real power_of_now(const budget *f, const real *v)
{
    const int32_t I = f->s.I, L = f->s.L;
    const real g = root(short_window(f));
    real *part = work_row(f, 1), *wide = work_row(f, 2), power = 0;
    for (int32_t a = 0; a < I; a++) {
        copy(wide, v + times(a, L), (size_t)L);
        clear(wide + L, (size_t)L);
        for (int32_t i = 0; i < I; i++) {
            const real *R = f->short_R + times(i * I + a, L);
            real taper = 1, sum = 0;
            correlate(part, v + times(i, L), L, wide, L); /* sum_m v_a(m + l) v_i(m) */
            for (int32_t l = 0; l < L; l++) {
                sum += (real)(l ? 2 : 1) * taper * R[l] * part[l];
                taper *= g;
            }
            power += sum;
        }
    }
    return power / f->weight[1];
}

/* Return the largest factor on the power of filter v that loudspeaker j's account can afford, if
 * the noise goes on: that of the last block for a short time, and that of the window of x, for
 * which v takes `power`, for longer. If a silence has `saved` power, the present level must be
 * affordable for even longer: otherwise the saved power would be spent at once, and be missing
 * later. */
static real affordable(const budget *f, int32_t j, const real *v, real power, real level, int saved)
{
    const int32_t T = f->T, block = T / BLOCK_LASTS, window = T / WINDOW_LASTS;
    const real rated = f->s.setting[RATED_POWER][j], of_block = power_of_block(f, v);
    const real of_now = power * (level < 1 ? level : 1);
    real spent = 0, factor = 0;
    for (int32_t n = T - 1; n >= block; n--) { /* spent, and still counted n blocks from now */
        spent += f->book[times(T - 1 - n, f->s.J) + (size_t)j];
        const int longer = saved && n > window && n <= T - window;
        if (!longer && n != window && n != block) continue;
        const real left = larger((real)T - spent, LEAST_SHARE * (real)n);
        const real expected = longer ? of_now : n == window ? power : of_block;
        const real afforded = left / (real)n * rated / larger(expected, LEAST_POWER);
        if (factor == 0 || afforded < factor) factor = afforded;
    }
    return factor;
}

/* Set the price of loudspeaker j, and its filter at that price, given what the others leave. */
static void spend(budget *f, int32_t j, const real *rest, real left)
{
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L;
    const size_t row = (size_t)(2 * L - 1), row_C = (size_t)(2 * f->lags - 1);
    const real rated = f->s.setting[RATED_POWER][j];
    real *v = taps_of(f, SOLUTION), q = 0;
    toeplitz_system t = {
        .f = f,
        .A = f->A + times(j * I * J + j, I) * row,
        .row_A = times(J, I) * row,
        .next_A = row,
        .R = f->C + (f->lags - L),
        .row_R = times(I, 1) * row_C,
        .next_R = row_C,
        .b = rest,
    };
    int solved;
    for (int32_t i = 0; i < I && !(t.scale > 0); i++) { /* of the first reference that is heard */
        const real *A = t.A + (t.row_A + t.next_A) * (size_t)i;
        const real *R = t.R + (t.row_R + t.next_R) * (size_t)i;
        t.scale = A[L - 1] / larger(R[L - 1], LEAST_POWER);
    }
    /* 1 The price at which the filter spends the rating, for the spectrum of the window of x and
     * the level of the shorter one, which the last filter tells. */
    const real *last = weights_of(&f->s, j);
    multiply_toeplitz(f, taps_of(f, PLAYED), t.R, t.row_R, t.next_R, last);
    const real usual = dot(last, taps_of(f, PLAYED), I * L), now = power_of_now(f, last);
    const real level = usual > 0 && now > 0 ? now / usual : 1;
    f->steady[j] = price_of(&t, rated / level, f->steady[j], v);
    /* 2 What the account holds makes power cheaper, but none that saves little of the noise. */
    for (int32_t k = 0; k < f->s.K; k++) q += f->posterior.q[k];
    const real cheaper = larger(1 - CHEAPER * larger(left, 0), CHEAPEST);
    real price = larger(f->steady[j] * cheaper, WORTHWHILE * q / (rated * (real)J));
    const real power = power_at(&t, price, v, taps_of(f, PLAYED), &solved);
    /* 3 The account must afford it, for longer if more is left than the price follows. */
    const int saved = CHEAPER * left > 1 - CHEAPEST;
    const real factor = power > 0 ? affordable(f, j, v, power, level, saved) : 1;
    if (factor < 1) price = price_of(&t, factor * power, price, v);
    f->price[j] = price;
    copy(weights_of(&f->s, j), v, times(I, L));
}

/* Set the correlations of x'_ji with x'_ac, and those of x'_ac with x'_ji:
 * E[x'_ji(t) x'_ac(t - l)] = sum_u (s_j ~ s_a)(u) C_ic(l - u), where
 * (s_a ~ s_j)(u) = (s_j ~ s_a)(-u). */
static void correlate_pair(budget *f, int32_t j, int32_t i, int32_t a, int32_t c)
{
    const posterior *p = &f->posterior;
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L, M = f->s.M, lags = 2 * L - 1;
    const int32_t from = a == j && c == i ? L - 1 : 0; /* of one signal they are symmetric */
    const real *ss = p->ss + times(a * J + j, 2 * M - 1);
    const real *C = f->C + times(i * I + c, 2 * f->lags - 1) + (f->lags - L - M + 1 + from);
    real *A = f->A + times((j * I + i) * J * I + a * I + c, lags);
    real *other = f->A + times((a * I + c) * J * I + j * I + i, lags);
    correlate(A + from, ss, 2 * M - 1, C, lags - from);
    for (int32_t l = from ? L : 0; l < lags; l++) other[lags - 1 - l] = A[l];
}

/* Set the correlations of d with x'_ji:
 * E[d(t) x'_ji(t - l)] = sum_u (p_c ~ s_j)(u) C_ci(l - u), summed over c. */
static void correlate_disturbance(budget *f, int32_t j, int32_t i)
{
    const posterior *p = &f->posterior;
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L, M = f->s.M, N = p->N;
    real *b = f->b + times(j * I + i, L), *part = work_row(f, 0);
    clear(b, (size_t)L);
    for (int32_t c = 0; c < I; c++) {
        const real *ps = p->ps + times(c * J + j, N + M - 1);
        const real *C = f->C + times(c * I + i, 2 * f->lags - 1) + (f->lags - N);
        correlate(part, ps, N + M - 1, C, L);
        add_to(b, part, L);
    }
}

/* Set the correlations of all filtered references, and with the disturbance. */
static void correlate_filtered(budget *f)
{
    const int32_t I = f->s.I, J = f->s.J;
    for (int32_t j = 0; j < J; j++)
        for (int32_t i = 0; i < I; i++) {
            for (int32_t a = 0; a <= j; a++)
                for (int32_t c = 0; c < (a < j ? I : i + 1); c++) correlate_pair(f, j, i, a, c);
            correlate_disturbance(f, j, i);
        }
}

/* Give each loudspeaker in turn the filter of least expected error at its price, given the others'.
 */
static void solve_all(budget *f)
{
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L, n = I * L;
    const size_t row = (size_t)(2 * L - 1), row_A = times(J, I) * row;
    real *rest = taps_of(f, REST), *part = taps_of(f, PLAYED);
    if (f->posterior.counts[STALE]) expect(&f->posterior);
    correlate_references(f);
    correlate_filtered(f);
    for (int32_t j = 0; j < J; j++) {
        const real left = 1 - spent_by(f, j, f->T) / (real)f->T;
        copy(rest, f->b + times(j, n), (size_t)n);
        for (int32_t a = 0; a < J; a++) {
            if (a == j) continue;
            const real *A = f->A + times(j * I * J + a, I) * row;
            multiply_toeplitz(f, part, A, row_A, row, weights_of(&f->s, a));
            add_scaled(rest, -1, part, n);
        }
        spend(f, j, rest, left);
    }
}

/* A sample. */

static void end_block(budget *f)
{
    const int32_t J = f->s.J, B = f->posterior.B;
    take_references(f, f->R, f->lags, *f->s.setting[WINDOW], f->weight);
    take_references(f, f->short_R, f->s.L, short_window(f), f->weight + 1);
    if (*f->controlled) {
        memmove(f->book + J, f->book, sizeof(real) * times(f->T - 1, J));
        for (int32_t j = 0; j < J; j++)
            f->book[j] = f->asked[J + j] / (real)B / f->s.setting[RATED_POWER][j];
    }
    learn(&f->posterior, *f->s.setting[MEMORY]);
    if (f->posterior.counts[SILENT])
        clear(f->s.weights, times(f->s.J * f->s.I, f->s.L));
    else if (*f->posterior.fits && !f->posterior.counts[WAITING])
        solve_all(f);
    *f->controlled = 0;
    clear(f->asked + J, (size_t)J);
    set_room(f);
    begin_block(&f->posterior);
}

/* Return why a sample cannot be learned from, or ANC_DONE. */
static int fault_of(const budget *f, const real *error)
{
    const signals *s = &f->s;
    for (int32_t i = 0; i < s->I; i++)
        if (!within(*newest(&s->x, i), anc_loudest_learnt)) return ANC_LOUD_REFERENCE;
    for (int32_t j = 0; j < s->J; j++) {
        if (!within(*newest(&s->y, j), anc_loudest)) return ANC_LOUD_REFERENCE;
        if (!within(f->asked[j], anc_loudest)) return ANC_LOUD_REFERENCE;
    }
    for (int32_t k = 0; error && k < s->K; k++)
        if (!within(error[k], anc_loudest_learnt)) return ANC_LOUD_ERROR;
    return ANC_DONE;
}

/* Note a sample; at the end of a block, learn. */
static int note(budget *f, const real *error, int controlled)
{
    const signals *s = &f->s;
    posterior *p = &f->posterior;
    int refused = fault_of(f, error);
    if (!refused && error) refused = anc_take_error((anc_view *)f, error);
    if (refused) return refused;
    for (int32_t i = 0; i < s->I; i++) *place_of(p, i) = *newest(&s->x, i);
    for (int32_t j = 0; j < s->J; j++) {
        *place_of(p, s->I + j) = *newest(&s->y, j);
        if (controlled) f->asked[s->J + j] += f->asked[j] * f->asked[j];
    }
    *f->controlled |= controlled;
    if (complete_sample(p, error)) end_block(f);
    return ANC_DONE;
}

/* Cut clicks from the newest references. A sound that sets in after silence is cut, too, until the
 * peak has grown: nothing is learned while cut samples are in the delay lines. */
static void cut_clicks(budget *f)
{
    for (int32_t i = 0; i < f->s.I; i++) {
        real *x = newest(&f->s.x, i), size = *x < 0 ? -*x : *x;
        const real most = GROWTH * f->peak[i];
        if (most > 0 && size > most) {
            size = most;
            *x = *x < 0 ? -most : most;
            f->posterior.heard[HEARD] = -1 - f->posterior.heard[FILLED];
        }
        f->peak[i] = larger(size, faded(f->peak[i], *f->s.setting[WINDOW], 0));
    }
}

static int control_signal_budget(anc_view *view, const real *reference, real *control)
{
    budget *f = (budget *)view;
    signals *s = &f->s;
    if (is_too_loud(s, reference)) return ANC_LOUD_REFERENCE;
    if (f->posterior.heard[AWAITED]) note(f, NULL, 1); /* that error never came */
    const int refused = take_reference(s, reference);
    f->posterior.heard[AWAITED] = !refused;
    if (refused) return refused;
    cut_clicks(f);
    for (int32_t j = 0; j < s->J; j++) {
        const real left = larger(f->asked[2 * s->J + j] - f->asked[s->J + j], 0), most = root(left);
        const real y = filter_output(s, j);
        f->asked[j] = y * y <= left ? y : y < 0 ? -most : most;
        emit(s, j, f->asked[j]);
        control[j] = s->control[j];
    }
    return ANC_DONE;
}

static int update_budget(anc_view *view, const real *error)
{
    return note((budget *)view, error, 1);
}
static int listen_budget(anc_view *view, const real *error)
{
    cut_clicks((budget *)view);
    return note((budget *)view, error, 0);
}

const anc_algorithm anc_power_budget = {.name = "KF-PB",
                                        .settings = budget_settings,
                                        .layout = layout_budget,
                                        .start = start_budget,
                                        .unfiltered = 1,
                                        .control_signal = control_signal_budget,
                                        .update = update_budget,
                                        .listen = listen_budget};
