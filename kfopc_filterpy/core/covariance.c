#include "covariance.h"
#include <string.h>

/* Both in rounding errors of the largest variance. For an h of energy 1, an h'P h below BLUR is nothing but rounding.
 * From then on, and in float always, the state noise is at least LEAST_NOISE. See `blurred`. */
static const real BLUR = 16, LEAST_NOISE = 2;
/* P fades until its largest variance is WIDEST times the usual one along the rows. From then on, state noise of the same size
 * along the rows takes the place of fading, so that the others hardly grow. The usual variance falls by e^FALL at most while a
 * row passes, so that a bad sample does not count, and rises with RELEASE of the fading. It is known when h'P h first exceeds
 * TELLING of q: before, the signal may be so soft that P must grow, up to UNKNOWN times the variance at the start: any
 * further, and the weights would follow the noise of the first samples. */
static const real WIDEST = 1e4, FALL = 4, RELEASE = (real)0.0625, TELLING = (real)1e-4, UNKNOWN = (real)1e6;
#ifdef ANC_FLOAT
static const real ROUNDING = FLT_EPSILON, MOST = 1e36f;
#else
static const real ROUNDING = DBL_EPSILON, MOST = 1e300;
#endif

void layout_covariance(covariance *c, int32_t n, anc_layout *at)
{
    c->n = n, c->padded = padded(n);
    c->owed = (anc_owed *)reals(at, "owed", ANC_STATE, 1, 1, 1, sizeof(anc_owed) / sizeof(real));
    c->u = reals(at, "gain_direction", ANC_STATE, 1, 1, 1, c->padded);
    c->T = reals(at, "triangle", ANC_STATE, 1, c->padded / PARTS, c->padded / PARTS + 1, PARTS * PARTS / 2);
    c->h = reals(at, "row", ANC_SCRATCH, 1, 1, 1, c->padded);
    c->Ph = reals(at, "P_row", ANC_SCRATCH, 1, 1, 1, c->padded);
    c->lifting = reals(at, "lifting", ANC_SCRATCH, 1, 1, 2, c->padded);
}

void start_covariance(covariance *c, real initial_variance)
{
    for (int32_t i = 0; i < c->n; i++) row_of(c, i)[i] = initial_variance;
    *c->owed = (anc_owed){.scale = 1, .largest = initial_variance, .bound = initial_variance, .floored = sizeof(real) < sizeof(double)};
}

static real largest_variance(const covariance *c)
{
    real most = c->T[0];
    for (int32_t i = 1; i < c->n; i++) {
        const real variance = row_of(c, i)[i];
        if (variance > most) most = variance;
    }
    return most;
}

int predictable(const covariance *c, real fading, real state_noise, real energy)
{
    const real scale = fading * c->owed->scale, diagonal = fading * c->owed->diagonal + state_noise;
    real bound = c->owed->bound; /* often too large, but at hand */
    for (int i = 0; i < 2; i++, bound = largest_variance(c)) {
        const real variance = scale * bound + diagonal; /* h'P h <= trace(P) h'h */
        if (variance <= MOST && (real)c->n * variance * energy <= MOST) return 1;
    }
    return 0;
}

void predict(covariance *c, real fading, real state_noise)
{
    anc_owed *owed = c->owed;
    if (fading > 1) {
        const real most = owed->usual > 0 ? WIDEST * owed->usual : UNKNOWN * owed->largest;
        owed->usual *= 1 + (fading - 1) * RELEASE;
        if (owed->scale * owed->bound > most) owed->bound = largest_variance(c);
        if (owed->scale * owed->bound > most) state_noise += (fading - 1) * owed->usual, fading = 1;
    }
    owed->scale *= fading;
    owed->diagonal = fading * owed->diagonal + state_noise;
}

/* Set T to T - pending u u' + diagonal I and Ph to T h in one pass, two rows at a time; return h' T h. `pending` is 0
 * or 1, so that the elements (i, j) and (j, i) of a group are rounded alike. */
static real pass(covariance *c, real pending, real diagonal)
{
    const real *restrict u = c->u, *restrict h = c->h;
    real *restrict Ph = c->Ph, *row = c->T;
    for (int32_t i = 0; i < c->padded; i += 2) {
        const int32_t group = i / PARTS * PARTS, length = group + PARTS;
        real *restrict a = row, *restrict b = row + length;
        const real ua = pending * u[i], ub = pending * u[i + 1], ha = h[i], hb = h[i + 1];
        vector sum_a[VECTORS], sum_b[VECTORS];
        real part_a[PARTS], part_b[PARTS];
        for (int v = 0; v < VECTORS; v++) sum_a[v] = sum_b[v] = zero;
        for (int32_t j = 0; j < length; j += PARTS)
            for (int v = 0; v < VECTORS; v++) {
                const vector pa = vectors(a + j)[v] - ua * vectors(u + j)[v], pb = vectors(b + j)[v] - ub * vectors(u + j)[v];
                vectors_of(a + j)[v] = pa, vectors_of(b + j)[v] = pb;
                sum_a[v] += pa * vectors(h + j)[v], sum_b[v] += pb * vectors(h + j)[v];
                if (j < group) vectors_of(Ph + j)[v] += pa * ha + pb * hb; /* the upper triangle's */
            }
        for (int v = 0; v < VECTORS; v++) vectors_of(part_a)[v] = sum_a[v], vectors_of(part_b)[v] = sum_b[v];
        Ph[i] = total(part_a), Ph[i + 1] = total(part_b);
        if (i < c->n) a[i] += diagonal, Ph[i] += diagonal * ha;
        if (i + 1 < c->n) b[i + 1] += diagonal, Ph[i + 1] += diagonal * hb;
        row += 2 * length;
    }
    return dot(h, Ph, c->padded);
}

/* Set T to scale (T - pending u u'). This is needed for a fading memory only: in `pass`, (scale u_i) u_j would not
 * equal (scale u_j) u_i to the bit, and fading makes such a difference grow. */
static void fade(covariance *c)
{
    const real *restrict u = c->u;
    real *restrict row = c->T;
    for (int32_t i = 0; i < c->padded; i++) {
        const int32_t length = i / PARTS * PARTS + PARTS;
        const real ui = c->owed->pending * u[i], scale = c->owed->scale;
        for (int32_t j = 0; j < length; j++) row[j] = scale * (row[j] - ui * u[j]);
        row += length;
    }
    c->owed->pending = 0;
}

/* Set g to T x. */
static void multiply(const covariance *c, const real *x, real *g)
{
    const real *a = c->T;
    memset(g, 0, sizeof(real) * (size_t)c->padded);
    for (int32_t i = 0; i < c->padded; i++) {
        const int32_t group = i / PARTS * PARTS;
        g[i] += dot(a, x, group + PARTS);
        add_scaled(g, x[i], a, group); /* the upper triangle's */
        a += group + PARTS;
    }
}

/* Raise the whole diagonal, because h'P h is negative or below `least`; return the new h'P h.
 *
 * If P stayed indefinite, each downdate would make its negative eigenvalue larger. That eigenvalue is estimated by the
 * lesser one of [a, b; b, d], which is P in the plane of h and P h. */
static real lift(covariance *c, real variance, real least)
{
    real *x = c->lifting, *Px = c->lifting + c->padded;
    const real energy = dot(c->h, c->h, c->n), a = variance / energy;
    if (!(energy > 0)) return 0; /* too small to carry information */
    for (int32_t i = 0; i < c->padded; i++) x[i] = c->Ph[i] - a * c->h[i];
    multiply(c, x, Px);
    const real size = dot(x, x, c->padded), b2 = size / energy, d = dot(x, Px, c->padded) / size;
    const real half = (real)fabs(a - d) / 2, value = (a < d ? a : d) - b2 / (half + root(half * half + b2));
    const real missing = within(value, MOST) ? value : a;
    real amount = missing < 0 ? ROUNDING * c->owed->bound - 2 * missing : 0;
    if (variance + amount * energy < least) amount = (least - variance) / energy;
    for (int32_t i = 0; i < c->n; i++) row_of(c, i)[i] += amount, c->Ph[i] += amount * c->h[i];
    c->owed->bound += amount;
    return dot(c->h, c->Ph, c->n);
}

/* Return an h'P h that may be lost in the rounding of P, and make sure that P recovers. It is raised if it is negative, or
 * if q does not cover the rounding either.
 *
 * If P is large along some directions and the reference excites only others, the variances along these fall below the
 * last digit of P's elements, and rounding may make them negative. Each sample would then reduce 1/P further, until S
 * turns negative. So from then on P gets as much state noise as its largest element is rounded by. */
static real blurred(covariance *c, real variance, real blur, real q)
{
    c->owed->bound = largest_variance(c);
    const real lost = blur * c->owed->bound;
    if (variance < lost) c->owed->floored = 1;
    return variance < 0 || variance + q < lost ? lift(c, variance, lost - q) : variance;
}

real project(covariance *c, real q)
{
    anc_owed *owed = c->owed;
    if (owed->floored != 0) {
        const real most = largest_variance(c), least = LEAST_NOISE * ROUNDING * (most < owed->largest ? most : owed->largest);
        if (owed->diagonal < least) owed->diagonal = least;
    }
    owed->bound = owed->scale * owed->bound + owed->diagonal;
    if (owed->scale != 1) fade(c);
    const real variance = pass(c, owed->pending, owed->diagonal), energy = dot(c->h, c->h, c->n), blur = BLUR * ROUNDING * energy;
    if (energy > 0 && variance > TELLING * q) {
        const real along = variance / energy;
        owed->usual = owed->usual > 0 ? held_value(owed->usual, along, 1 / (1 + FALL / (real)c->n), 1) : along;
    }
    owed->scale = 1, owed->diagonal = owed->pending = 0;
    return variance < blur * owed->bound ? blurred(c, variance, blur, q) : variance;
}

int tells(const covariance *c, real S) { return S > 0 && root(c->owed->bound) <= anc_longest_step * root(S); }

real downdate(covariance *c, real S)
{
    real *restrict u = c->u;
    const real *restrict Ph = c->Ph;
    const int32_t n = c->padded;
    const real inverse_root = 1 / root(S);
    for (int32_t j = 0; j < n; j++) u[j] = Ph[j] * inverse_root;
    c->owed->pending = 1;
    return inverse_root;
}

int correct(const covariance *c, real *w, real innovation, real inverse_root, real most)
{
    /* K y = u step, and no element of u is above the root of the largest variance. */
    const real step = innovation * inverse_root;
    if (!within(root(c->owed->bound) * step, most)) return 0;
    add_scaled(w, step, c->u, c->n);
    return 1;
}

/* A covariance alone, in memory of the host. */

static covariance in_memory(void *memory, int32_t n)
{
    covariance c;
    anc_layout at = {.memory = memory};
    layout_covariance(&c, n, &at);
    return c;
}

size_t anc_covariance_size(int32_t n)
{
    covariance c;
    anc_layout at = {0};
    layout_covariance(&c, n, &at);
    return at.size;
}

void anc_covariance_describe(int32_t n, anc_visitor *visit, void *to)
{
    covariance c;
    anc_layout at = {.visit = visit, .to = to};
    layout_covariance(&c, n, &at);
}

void anc_covariance_predict(void *memory, int32_t n, anc_real r, anc_real fading)
{
    covariance c = in_memory(memory, n);
    predict(&c, fading, r);
}

int anc_covariance_update(void *memory, int32_t n, anc_real *w, const anc_real *h, anc_real z, anc_real q, anc_real result[2])
{
    covariance c = in_memory(memory, n);
    if (!predictable(&c, 1, 0, dot(h, h, n))) return ANC_NO_SOLUTION;
    memcpy(c.h, h, sizeof(real) * (size_t)n);
    const real S = project(&c, q) + q, y = z - dot(h, w, n);
    result[0] = y, result[1] = S;
    if (!(S > 0)) return ANC_NO_SOLUTION;
    if (!within(root(c.owed->bound) * (y / root(S)), MOST)) return ANC_LOUD_STEP;
    const real inverse_root = downdate(&c, S);
    correct(&c, w, y, inverse_root, MOST);
    return ANC_DONE;
}
