#include "covariance.h"

/* Both in rounding errors of the largest variance. For a row h of energy 1, an h'P h below BLUR is
 * nothing but rounding. From then on, and in float always, the state noise is at least LEAST_NOISE.
 */
static const real BLUR = 16, LEAST_NOISE = 2;
/* P fades until its largest variance is WIDEST times the usual one along the rows. From then on,
 * state noise of the same size along the rows takes the place of fading, and P is scaled down so
 * far that the largest variance stays. The usual variance falls by at most e^FALL while a row
 * passes, so that a bad sample does not count, and rises with RELEASE of the fading; it waits while
 * the rows tell nothing. */
static const real WIDEST = 1e4, FALL = 4, RELEASE = (real)0.0625;
/* The usual variance is known when h'P h first exceeds TELLING of q. Before, the signal may be so
 * soft that P must grow, up to UNKNOWN times the variance at the start: any further, and the
 * weights would follow the noise of the first samples. */
static const real TELLING = (real)1e-4, UNKNOWN = (real)1e6;
#ifdef ANC_FLOAT
static const real ROUNDING = FLT_EPSILON, MOST = 1e36f;
#else
static const real ROUNDING = DBL_EPSILON, MOST = 1e300;
#endif

void layout_covariance(covariance *c, int32_t n, anc_layout *at)
{
    const int32_t groups = (n + PARTS - 1) / PARTS;
    c->n = n;
    c->padded = groups * PARTS;
    c->owed = structs(at, "owed", ANC_STATE, 1, 1, 1, sizeof *c->owed);
    c->u = reals(at, "gain_direction", ANC_STATE, 1, 1, 1, c->padded);
    c->T = reals(at, "triangle", ANC_STATE, 1, groups, groups + 1, PARTS * PARTS / 2);
    c->h = reals(at, "row", ANC_SCRATCH, 1, 1, 1, c->padded);
    c->Ph = reals(at, "P_row", ANC_SCRATCH, 1, 1, 1, c->padded);
    c->lifting = reals(at, "lifting", ANC_SCRATCH, 1, 1, 2, c->padded);
}

/* The first element of row i of T. */
static real *row_of(const covariance *c, int32_t i)
{
    const int32_t group = i / PARTS;
    return c->T + times(group, group + 1) * (PARTS * PARTS / 2) +
           times(i % PARTS, group + 1) * PARTS;
}

void start_covariance(covariance *c, real initial_variance)
{
    for (int32_t i = 0; i < c->n; i++) row_of(c, i)[i] = initial_variance;
    c->owed->scale = 1;
    c->owed->largest = initial_variance;
    c->owed->bound = initial_variance;
    c->owed->floored = sizeof(real) < sizeof(double);
}

static real largest_variance(const covariance *c)
{
    real most = c->T[0];
    for (int32_t i = 1; i < c->n; i++) most = larger(row_of(c, i)[i], most);
    return most;
}

/* Return whether P and h'P h stay finite in a prediction from variances of at most `bound`. */
static int stays_finite(const covariance *c, real bound, real fading, real r, real energy)
{
    const real variance = fading * (bound + c->owed->diagonal) + r;
    return variance <= MOST && (real)c->n * variance * energy <= MOST; /* h'P h <= trace(P) h'h */
}

int predictable(const covariance *c, real fading, real r, real energy)
{
    if (stays_finite(c, c->owed->bound, fading, r, energy)) return 1; /* often too large a bound */
    return stays_finite(c, largest_variance(c), fading, r, energy);
}

void predict(covariance *c, real fading, real r)
{
    owed_numbers *owed = c->owed;
    if (fading > 1) {
        const real most = owed->usual > 0 ? WIDEST * owed->usual : UNKNOWN * owed->largest;
        owed->release = (fading - 1) * RELEASE;
        if (owed->bound > most) owed->bound = largest_variance(c);
        if (owed->bound > most) {
            const real noise = (fading - 1) * owed->usual;
            fading = 1 - noise / owed->bound;
            r += noise;
        }
    }
    owed->scale = fading;
    owed->diagonal = fading * owed->diagonal + r;
}

/* Set T to T - pending u u' + diagonal I and Ph to T h in one pass, two rows at a time; return h' T
 * h. `pending` is 0 or 1, so that the elements (i, j) and (j, i) of a group are rounded alike. */
static real pass(covariance *c, real pending, real diagonal)
{
    const real *restrict u = c->u, *restrict h = c->h;
    real *restrict Ph = c->Ph, *row = c->T;
    for (int32_t i = 0; i < c->padded; i += 2) {
        const int32_t group = i / PARTS * PARTS, length = group + PARTS;
        const real ua = pending * u[i], ub = pending * u[i + 1], ha = h[i], hb = h[i + 1];
        real *restrict a = row, *restrict b = row + length;
        vector sum_a[VECTORS], sum_b[VECTORS];
        for (int v = 0; v < VECTORS; v++) sum_a[v] = sum_b[v] = zero;
        for (int32_t j = 0; j < length; j += PARTS)
            for (int v = 0; v < VECTORS; v++) {
                const vector uj = vectors(u + j)[v], hj = vectors(h + j)[v];
                const vector pa = vectors(a + j)[v] - ua * uj;
                const vector pb = vectors(b + j)[v] - ub * uj;
                vectors_of(a + j)[v] = pa;
                vectors_of(b + j)[v] = pb;
                sum_a[v] += pa * hj;
                sum_b[v] += pb * hj;
                if (j < group)
                    vectors_of(Ph + j)[v] += pa * ha + pb * hb; /* the upper triangle's */
            }
        Ph[i] = total_of(sum_a);
        Ph[i + 1] = total_of(sum_b);
        if (i < c->n) {
            a[i] += diagonal;
            Ph[i] += diagonal * ha;
        }
        if (i + 1 < c->n) {
            b[i + 1] += diagonal;
            Ph[i + 1] += diagonal * hb;
        }
        row += 2 * length;
    }
    return dot(h, Ph, c->padded);
}

/* Set T to scale (T - pending u u'). This is needed for a fading memory only: in `pass`,
 * (scale u_i) u_j would not equal (scale u_j) u_i to the bit, and fading makes such a difference
 * grow. */
static void fade(covariance *c)
{
    const real *restrict u = c->u;
    const real scale = c->owed->scale;
    for (int32_t i = 0; i < c->padded; i++) {
        const real ui = c->owed->pending * u[i];
        real *restrict row = row_of(c, i);
        for (int32_t j = 0; j < i / PARTS * PARTS + PARTS; j++)
            row[j] = scale * (row[j] - ui * u[j]);
    }
    c->owed->pending = 0;
}

/* Set g to T x. */
static void multiply(const covariance *c, const real *x, real *g)
{
    clear(g, (size_t)c->padded);
    for (int32_t i = 0; i < c->padded; i++) {
        const int32_t group = i / PARTS * PARTS;
        g[i] += dot(row_of(c, i), x, group + PARTS);
        add_scaled(g, x[i], row_of(c, i), group); /* the upper triangle's */
    }
}

/* Return about the least eigenvalue of P, if it is negative, from h'P h. */
static real least_eigenvalue(const covariance *c, real variance, real energy)
{
    /* P in the plane of h and P h is [a, b; b, d], in the directions of h and x = P h - a h:
     * a = h'P h / h'h, b^2 = x'x / h'h, d = x'P x / x'x. */
    real *x = c->lifting, *Px = c->lifting + c->padded;
    const real a = variance / energy;
    for (int32_t i = 0; i < c->padded; i++) x[i] = c->Ph[i] - a * c->h[i];
    multiply(c, x, Px);
    const real size = dot(x, x, c->padded), b2 = size / energy, d = dot(x, Px, c->padded) / size;
    const real half = (real)fabs(a - d) / 2;
    const real value = smaller(a, d) - b2 / (half + root(half * half + b2));
    return within(value, MOST) ? value : a; /* x may be too small to tell a direction */
}

/* Raise the whole diagonal, because h'P h is negative or below `least`; return the new h'P h. If P
 * stayed indefinite, each downdate would make its negative eigenvalue larger. */
static real lift(covariance *c, real variance, real least)
{
    const real energy = dot(c->h, c->h, c->n);
    if (!(energy > 0)) return 0; /* too small to carry information */
    const real value = least_eigenvalue(c, variance, energy);
    real amount = value < 0 ? ROUNDING * c->owed->bound - 2 * value : 0;
    if (variance + amount * energy < least) amount = (least - variance) / energy;
    for (int32_t i = 0; i < c->n; i++) {
        row_of(c, i)[i] += amount;
        c->Ph[i] += amount * c->h[i];
    }
    c->owed->bound += amount;
    return dot(c->h, c->Ph, c->n);
}

/* Return an h'P h that may be lost in the rounding of P, and make sure that P recovers: it is
 * raised if it is negative, or if q does not cover the rounding either.
 *
 * If P is large along some directions and the reference excites only others, the variances along
 * these fall below the last digit of P's elements, and rounding may make them negative. Each sample
 * would then reduce 1/P further, until S turns negative. So from then on P gets as much state noise
 * as its largest element is rounded by. */
static real blurred(covariance *c, real variance, real blur, real q)
{
    c->owed->bound = largest_variance(c);
    const real lost = blur * c->owed->bound;
    if (variance < lost) c->owed->floored = 1;
    return variance < 0 || variance + q < lost ? lift(c, variance, lost - q) : variance;
}

/* Follow the usual variance along the rows, from h'P h. */
static void note_usual(const covariance *c, real variance, real energy, real q)
{
    owed_numbers *owed = c->owed;
    if (!(energy > 0 && variance > TELLING * q)) return;
    const real along = variance / energy, fall = 1 / (1 + FALL / (real)c->n);
    const real last = owed->usual * (1 + owed->release);
    owed->usual = last > 0 ? held_value(last, along, fall, 1) : along;
    owed->release = 0; /* once a sample */
}

real project(covariance *c, real q)
{
    owed_numbers *owed = c->owed;
    if (owed->floored != 0) {
        const real most = smaller(largest_variance(c), owed->largest);
        owed->diagonal = larger(owed->diagonal, LEAST_NOISE * ROUNDING * most);
    }
    owed->bound = owed->scale * owed->bound + owed->diagonal;
    if (owed->scale != 1) fade(c);
    const real variance = pass(c, owed->pending, owed->diagonal);
    owed->scale = 1;
    owed->diagonal = 0;
    owed->pending = 0;
    const real energy = dot(c->h, c->h, c->n), blur = BLUR * ROUNDING * energy;
    note_usual(c, variance, energy, q);
    return variance < blur * owed->bound ? blurred(c, variance, blur, q) : variance;
}

int tells(const covariance *c, real S)
{
    return S > 0 && root(c->owed->bound) <= anc_longest_step * root(S);
}

real downdate(covariance *c, real S)
{
    const real inverse_root = 1 / root(S);
    for (int32_t j = 0; j < c->padded; j++) c->u[j] = c->Ph[j] * inverse_root;
    c->owed->pending = 1;
    return inverse_root;
}

void correct(const covariance *c, real *w, real innovation, real inverse_root)
{
    /* K y = u step, and no element of u is above the root of the largest variance. */
    const real step = innovation * inverse_root;
    if (within(root(c->owed->bound) * step, anc_longest_step)) add_scaled(w, step, c->u, c->n);
}
