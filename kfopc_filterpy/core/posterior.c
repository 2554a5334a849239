#include "posterior.h"

/* A surprise is an error beyond this many times the noise and the doubt: the error of a steady
 * recording reaches four times its mean, and to forget costs about as much. */
static const real SURPRISE = 6;
/* rms error over the path, if it gave way to an independent one of the same size: sqrt(2). */
static const real REDRAWN = (real)1.4142135623730951;
/* A noise so far beyond the disturbance that x foretells, which is so far below the usual one, has
 * no part of x: a plant of the same size leaves an error of up to four times the disturbance. */
static const real FOREIGN = 16;
/* What a block leaves to the next of a sound that is longer than the paths: a reverberation time of
 * 0.64 s. */
static const real FADES = (real)0.5;
/* A surprise is located to this part of a block. */
enum { EIGHTHS = 8 };
/* A fit begins when this share of the data is new. */
static const real NEWS = (real)0.125;
/* Operations of a factorisation in a block, 2^26. */
static const double WORK = 67108864;

/* Correlations. Every sum is in the order of k, whatever the number of sums that are formed at
 * once. */

/* Set the next `vectors_at_once` WIDE sums. */
static inline void sums_of(real *restrict to, const real *restrict a, int32_t n,
                           const real *restrict b, const int vectors_at_once)
{
    vector sum[8];
    for (int v = 0; v < vectors_at_once; v++) sum[v] = zero;
    for (int32_t k = 0; k < n; k++)
        for (int v = 0; v < vectors_at_once; v++) sum[v] += a[k] * vectors(b + k)[v];
    for (int v = 0; v < vectors_at_once; v++) vectors_of(to)[v] = sum[v];
}

void correlate(real *restrict to, const real *restrict a, int32_t n, const real *restrict b,
               int32_t count)
{
    int32_t l = 0;
    for (; l + 8 * WIDE <= count; l += 8 * WIDE) sums_of(to + l, a, n, b + l, 8);
    for (; l + 4 * WIDE <= count; l += 4 * WIDE) sums_of(to + l, a, n, b + l, 4);
    if (l < count && count >= 4 * WIDE) { /* the last ones, some of them again */
        l = count - 4 * WIDE;
        sums_of(to + l, a, n, b + l, 4);
        return;
    }
    for (; l + WIDE <= count; l += WIDE) sums_of(to + l, a, n, b + l, 1);
    for (; l < count; l++) {
        real sum = 0;
        for (int32_t k = 0; k < n; k++) sum += a[k] * b[l + k];
        to[l] = sum;
    }
}

/* Layout. */

static int32_t whole(int32_t n) { return (n + PARTS - 1) / PARTS * PARTS; }

/* G is the lower triangle, one row after the other, in groups of PARTS rows that all end with the
 * group's last column. */
static real *row_of_data(const posterior *f, int32_t i)
{
    const int32_t group = i / PARTS;
    return f->G + times(group, group + 1) * (PARTS * PARTS / 2) +
           times(i % PARTS, group + 1) * PARTS;
}

/* The factor has the same groups, each with its columns one after the other: a panel. */
static real *panel_of(const posterior *f, int32_t group)
{
    return f->factor + times(group, group + 1) * (PARTS * PARTS / 2);
}

void layout_posterior(posterior *f, const signals *s, int32_t block, int exact, anc_layout *at)
{
    const int32_t K = s->K, J = s->J, I = s->I, M = s->M, N = s->L + M - 1;
    const int32_t n = I * N + (exact ? 0 : J * M);
    const int32_t groups = whole(n) / PARTS;
    *f = (posterior){.K = K, .J = J, .I = I, .N = N, .M = M, .B = block, .n = n, .exact = exact};
    f->padded = whole(n);
    f->history = s->L + N + block;
    f->width = 3 * N + block;
    f->delay = (int32_t)((double)n * n * n / 3 / WORK);
    f->path = s->path;
    f->numbers = structs(at, "posterior", ANC_STATE, 1, 1, 1, sizeof *f->numbers);
    f->counts = int32s(at, "posterior_counts", ANC_STATE, POSTERIOR_COUNTS);
    f->fits = int32s(at, "fits", ANC_STATE, 1);
    f->alarms = int32s(at, "alarms", ANC_STATE, 1);
    f->z = reals(at, "history", ANC_STATE, 1, 1, I + J, f->history);
    f->errors = reals(at, "block_errors", ANC_STATE, 1, 1, K, block);
    f->heard = int32s(at, "block_counts", ANC_STATE, BLOCK_COUNTS);
    f->theta = reals(at, "theta", ANC_STATE, 1, 1, K, n);
    f->q = reals(at, "noise", ANC_STATE, 1, 1, 1, K);
    f->draws = reals(at, "draws", ANC_STATE, 1, 1, exact ? 0 : DRAWS, n);
    f->G = reals(at, "data", ANC_STATE, 1, groups, groups + 1, PARTS * PARTS / 2);
    f->r = reals(at, "data_of_errors", ANC_STATE, 1, 1, K, n);
    f->ee = reals(at, "error_energy", ANC_STATE, 1, 1, 1, K);
    f->factor = reals(at, "factor", ANC_STATE, 1, groups, groups + 1, PARTS * PARTS / 2);
    f->inverse = reals(at, "inverse_diagonal", ANC_STATE, 1, 1, 1, f->padded);
    f->set_r = reals(at, "set_aside_of_errors", ANC_STATE, 1, 1, K, n);
    f->set_ee = reals(at, "set_aside_energy", ANC_STATE, 1, 1, 1, K);
    f->ss = reals(at, "path_correlation", ANC_STATE, 1, J, J, 2 * M - 1);
    f->ps = reals(at, "cross_correlation", ANC_STATE, 1, I, J, N + M - 1);
    f->sides = reals(at, "right_sides", ANC_SCRATCH, 1, 1, f->padded + J * M, PARTS);
    f->work = reals(at, "posterior_work", ANC_SCRATCH, 1, 1, POSTERIOR_ROWS, f->width);
}

void start_posterior(posterior *f, real spread)
{
    const int32_t split = f->I * f->N, taps = f->n - split;
    f->numbers->spread = spread;
    f->counts[RANDOM] = 1;
    for (int32_t k = 0; taps && k < f->K; k++)
        copy(f->theta + times(k, f->n) + split, f->path + times(k, taps), (size_t)taps);
}

/* Return the mean of sum_m s(m)^2 over the secondary paths. */
static real size_of_path(const posterior *f)
{
    const int32_t paths = f->K * f->J;
    real sum = 0;
    for (int32_t kj = 0; kj < paths; kj++) {
        const real *path = f->path + times(kj, f->M);
        sum += dot(path, path, f->M);
    }
    return sum / (real)paths;
}

static real mean_noise(const posterior *f)
{
    real sum = 0;
    for (int32_t k = 0; k < f->K; k++) sum += f->q[k];
    return sum / (real)f->K;
}

static real *work_of(const posterior *f, int32_t row) { return f->work + times(row, f->width); }

/* A fit: theta = (G + q P)^-1 (r + q P mean), with the precision P of the prior. */

/* Return the precision of element i. */
static real precision_of(const posterior *f, int32_t i, real size)
{
    const real spread = f->numbers->spread;
    return i < f->I * f->N ? f->numbers->prior : (real)f->M / (spread * spread * size);
}

/* Return p'G p of microphone k, the energy of p * x in the data. */
static real energy_explained(const posterior *f, int32_t k)
{
    const int32_t split = f->I * f->N;
    const real *theta = f->theta + times(k, f->n);
    real energy = 0;
    for (int32_t i = 0; i < split; i++) {
        const real *row = row_of_data(f, i);
        energy += theta[i] * (2 * dot(row, theta, i) + row[i] * theta[i]);
    }
    return energy;
}

/* Return the energy of p * x in the data, at all microphones. */
static real explained(const posterior *f)
{
    real energy = 0;
    for (int32_t k = 0; k < f->K; k++) energy += energy_explained(f, k);
    return energy;
}

/* Set what the data hold: samples, energy of x, energy of y. */
static void weigh_data(const posterior *f, real held[3])
{
    const int32_t split = f->I * f->N;
    held[0] = f->numbers->samples;
    held[1] = held[2] = 0;
    for (int32_t i = 0; i < split; i += f->N) held[1] += row_of_data(f, i)[i];
    for (int32_t i = split; i < f->n; i += f->M) held[2] += row_of_data(f, i)[i];
}

/* Return whether there is news: of the samples, or of the energy of x or y. */
static int is_news(const posterior *f)
{
    real held[3];
    weigh_data(f, held);
    for (int i = 0; i < 3; i++)
        if (held[i] * (1 - NEWS) > f->numbers->fitted[i]) return 1;
    return 0;
}

/* Set the precision of the primary paths from |p|^2 = E[d^2 + e^2] / E[x^2] of the data of now, and
 * the first noise. Return 0 if nothing can be told yet. */
static int set_prior(posterior *f)
{
    posterior_numbers *known = f->numbers;
    real x2 = 0, e2 = 0, q = 0;
    for (int32_t i = 0; i < f->I * f->N; i++) x2 += row_of_data(f, i)[i];
    for (int32_t k = 0; k < f->K; k++) {
        if (!(f->ee[k] > 0)) return 0;
        e2 += f->ee[k];
        q += f->q[k];
    }
    if (!(x2 > 0)) return 0;
    known->prior = x2 * (real)f->K / (e2 + explained(f));
    for (int32_t k = 0; q == 0 && k < f->K; k++) f->q[k] = (real)1e-3 * f->ee[k] / known->samples;
    return 1;
}

/* Set aside the present data for a factorisation. */
static void begin_fit(posterior *f)
{
    posterior_numbers *known = f->numbers;
    if (!set_prior(f)) return;
    for (int32_t group = 0; group < f->padded / PARTS; group++) {
        const real *rows = row_of_data(f, group * PARTS);
        real *panel = panel_of(f, group);
        const int32_t columns = PARTS * (group + 1);
        for (int32_t c = 0; c < columns; c++)
            for (int32_t i = 0; i < PARTS; i++)
                panel[PARTS * c + i] = rows[times(i, columns) + (size_t)c];
    }
    copy(f->set_r, f->r, times(f->K, f->n));
    copy(f->set_ee, f->ee, (size_t)f->K);
    known->set_aside = known->samples;
    weigh_data(f, known->fitted);
    f->counts[PENDING] = f->delay + 1;
    f->counts[GROUPS] = 0;
}

/* Set S_ji = sum_k P_kj Q_ki, k < n: a square of PARTS by PARTS sums, WIDE of its rows at a time.
 */
static void multiply_panels(real S[PARTS * PARTS], const real *restrict P, const real *restrict Q,
                            int32_t n)
{
    for (int row = 0; row < PARTS; row += WIDE) {
        vector sum[WIDE][VECTORS];
        for (int j = 0; j < WIDE; j++)
            for (int v = 0; v < VECTORS; v++) sum[j][v] = zero;
        for (int32_t k = 0; k < n; k++)
            for (int j = 0; j < WIDE; j++)
                for (int v = 0; v < VECTORS; v++)
                    sum[j][v] += P[PARTS * k + row + j] * vectors(Q + PARTS * k)[v];
        for (int j = 0; j < WIDE; j++)
            for (int v = 0; v < VECTORS; v++) vectors_of(S + PARTS * (row + j))[v] = sum[j][v];
    }
}

/* Set element j of PARTS equations at once, X_j = (X_j - S_j - sum_(k < j) C_jk X_k) / C_jj,
 * without the division. */
static void eliminate(real *restrict X, const real *restrict S, const real *restrict C, int j)
{
    for (int i = 0; i < PARTS; i++) X[PARTS * j + i] -= S[PARTS * j + i];
    for (int k = 0; k < j; k++)
        for (int i = 0; i < PARTS; i++) X[PARTS * j + i] -= C[PARTS * k + j] * X[PARTS * k + i];
}

/* Factorise the next group of rows; return 0 if the matrix is not positive definite. */
static int factorise_group(posterior *f, int32_t group, real q, real size)
{
    real S[PARTS * PARTS], *panel = panel_of(f, group);
    for (int i = 0; i < PARTS; i++) {
        const int32_t row = PARTS * group + i;
        panel[PARTS * row + i] += row < f->n ? q * precision_of(f, row, size) : 1;
    }
    for (int32_t before = 0; before <= group; before++) {
        const real *other = panel_of(f, before), *C = other + PARTS * PARTS * before;
        real *X = panel + PARTS * PARTS * before, *inverse = f->inverse + PARTS * before;
        multiply_panels(S, other, panel, PARTS * before);
        for (int j = 0; j < PARTS; j++) {
            eliminate(X, S, before < group ? C : X, j);
            if (before == group) {
                const real pivot = X[PARTS * j + j];
                if (!(pivot > 0 && isfinite(pivot))) return 0;
                inverse[j] = 1 / root(pivot);
            }
            for (int i = 0; i < PARTS; i++) X[PARTS * j + i] *= inverse[j];
        }
    }
    return 1;
}

/* Solve C Z = Z for PARTS right sides. */
static void solve_forward(const posterior *f, real *Z)
{
    real S[PARTS * PARTS];
    for (int32_t group = 0; group < f->padded / PARTS; group++) {
        const real *panel = panel_of(f, group);
        real *X = Z + PARTS * PARTS * group;
        multiply_panels(S, panel, Z, PARTS * group);
        for (int j = 0; j < PARTS; j++) {
            eliminate(X, S, panel + PARTS * PARTS * group, j);
            for (int i = 0; i < PARTS; i++) X[PARTS * j + i] *= f->inverse[PARTS * group + j];
        }
    }
}

/* Solve C' Z = Z. */
static void solve_backward(const posterior *f, real *Z)
{
    for (int32_t group = f->padded / PARTS - 1; group >= 0; group--) {
        const real *panel = panel_of(f, group), *C = panel + PARTS * PARTS * group;
        real *restrict X = Z + PARTS * PARTS * group;
        for (int j = PARTS - 1; j >= 0; j--) {
            for (int k = j + 1; k < PARTS; k++)
                for (int i = 0; i < PARTS; i++)
                    X[PARTS * j + i] -= C[PARTS * j + k] * X[PARTS * k + i];
            for (int i = 0; i < PARTS; i++) X[PARTS * j + i] *= f->inverse[PARTS * group + j];
        }
        vector x[PARTS][VECTORS];
        for (int j = 0; j < PARTS; j++)
            for (int v = 0; v < VECTORS; v++) x[j][v] = vectors(X + PARTS * j)[v];
        for (int32_t c = 0; c < PARTS * group; c++)
            for (int v = 0; v < VECTORS; v++) {
                vector rest = vectors(Z + PARTS * c)[v];
                for (int j = 0; j < PARTS; j++) rest -= panel[PARTS * c + j] * x[j][v];
                vectors_of(Z + PARTS * c)[v] = rest;
            }
    }
}

/* Return a random sign: the upper bit of a linear congruential generator. */
static real sign_of(int32_t *random)
{
    const uint32_t next = (uint32_t)*random * 1664525u + 1013904223u;
    memcpy(random, &next, sizeof next);
    return next >> 31 ? 1 : -1;
}

/* The prior mean of element i of theta, of microphone k: 0 of p, s^ of s. */
static real prior_mean(const posterior *f, int32_t k, int32_t i)
{
    const int32_t split = f->I * f->N;
    return i < split ? 0 : f->path[times(k, f->n - split) + (size_t)(i - split)];
}

/* Set the noise of microphone k from sum e^2 - 2 theta'r + theta'G theta, where
 * G theta = r + q P (mean - theta). */
static void set_noise(posterior *f, int32_t k, real q, real size)
{
    const int32_t n = f->n, split = f->I * f->N;
    const real *theta = f->theta + times(k, n), *r = f->set_r + times(k, n);
    const real ee = f->set_ee[k], samples = f->numbers->set_aside;
    real bend = 0;
    for (int32_t i = 0; i < n; i++)
        bend += precision_of(f, i, size) * theta[i] * (prior_mean(f, k, i) - theta[i]);
    const real residual = ee - dot(theta, r, n) + q * bend;
    /* The earlier estimate counts as n samples: a short record leaves little noise by chance. */
    const real weight = larger(samples - (real)split / 2, 0) + (real)n;
    const real noise = (residual + (real)n * f->q[k]) / weight;
    f->q[k] = larger(noise, (real)1e-6 * ee / samples);
}

/* Solve for the means of up to PARTS microphones from `first` on, and set their noise. Return 0 if
 * a mean is not finite. */
static int solve_means(posterior *f, int32_t first, real q, real size)
{
    const int32_t n = f->n, split = f->I * f->N;
    const int32_t most = f->K - first < PARTS ? f->K - first : PARTS;
    real *Z = f->sides;
    clear(Z, times(f->padded, PARTS));
    for (int32_t c = 0; c < most; c++)
        for (int32_t i = 0; i < n; i++) {
            const real mean = prior_mean(f, first + c, i);
            const real pull = i < split ? 0 : q * precision_of(f, i, size) * mean;
            Z[PARTS * i + c] = f->set_r[times(first + c, n) + (size_t)i] + pull;
        }
    solve_forward(f, Z);
    solve_backward(f, Z);
    for (int32_t i = 0; i < n * PARTS; i++)
        if (!isfinite(Z[i])) return 0;
    for (int32_t c = 0; c < most; c++) {
        real *theta = f->theta + times(first + c, n);
        for (int32_t i = 0; i < n; i++) theta[i] = Z[PARTS * i + c];
        set_noise(f, first + c, q, size);
    }
    return 1;
}

/* Draw from the posterior: theta has the covariance q (C C')^-1 = q C'^-1 C^-1. */
static void set_draws(posterior *f, real q)
{
    const real scale = root(q);
    real *Z = f->sides;
    clear(Z, times(f->padded, PARTS));
    for (int32_t d = 0; d < DRAWS; d++)
        for (int32_t i = 0; i < f->n; i++) Z[PARTS * i + d] = sign_of(f->counts + RANDOM);
    solve_backward(f, Z);
    for (int32_t d = 0; d < DRAWS; d++)
        for (int32_t i = 0; i < f->n; i++)
            f->draws[times(d, f->n) + (size_t)i] = scale * Z[PARTS * i + d];
}

/* By chance alone, n taps explain n q. James and Stein: what is not significant is not played. */
static void keep_significant(posterior *f)
{
    const int32_t split = f->I * f->N;
    const real all = explained(f), chance = 2 * (real)split * (real)f->K * mean_noise(f);
    const real share = all > chance ? 1 - chance / all : 0;
    f->numbers->significant = share;
    for (int32_t k = 0; k < f->K; k++)
        for (int32_t i = 0; i < split; i++) f->theta[times(k, f->n) + (size_t)i] *= share;
}

/* The factor is complete: solve for the posterior. */
static void end_fit(posterior *f, real q, real size)
{
    for (int32_t first = 0; first < f->K; first += PARTS)
        if (!solve_means(f, first, q, size)) return;
    keep_significant(f);
    if (!f->exact) set_draws(f, q);
    count_up(f->fits);
    f->counts[WAITING] = f->counts[SILENT] = 0;
    f->counts[STALE] = 1;
}

/* Do this block's part of the factorisation; every block does about as much. */
static void go_on_fitting(posterior *f)
{
    const real q = mean_noise(f), size = size_of_path(f);
    const double groups = f->padded / PARTS, blocks = f->delay + 1;
    const double done = blocks + 1 - f->counts[PENDING], all = groups * groups * groups;
    for (double g = f->counts[GROUPS]; g < groups && g * g * g * blocks < all * done; g++) {
        if (!factorise_group(f, f->counts[GROUPS], q, size)) {
            f->counts[PENDING] = 0;
            return;
        }
        f->counts[GROUPS]++;
    }
    if (--f->counts[PENDING] == 0) end_fit(f, q, size);
}

/* A block. */

int complete_sample(posterior *f, const real *error)
{
    const int32_t at = f->B - 1 - f->heard[FILLED];
    for (int32_t k = 0; error && k < f->K; k++) f->errors[times(k, f->B) + (size_t)at] = error[k];
    f->heard[MISSING] |= !error;
    f->heard[AWAITED] = 0;
    return ++f->heard[FILLED] == f->B;
}

void begin_block(posterior *f)
{
    f->heard[FILLED] = f->heard[MISSING] = 0;
    for (int32_t i = 0; i < f->I + f->J; i++) {
        real *z = history_of(f, i);
        memmove(z + f->B, z, sizeof(real) * (size_t)(f->history - f->B));
    }
}

/* Set d to p * x and z to s * y of the block. */
static void explain(const posterior *f, const real *theta, real *d, real *z)
{
    real *part = work_of(f, 0);
    clear(d, (size_t)f->B);
    clear(z, (size_t)f->B);
    for (int32_t i = 0; i < f->I + (f->exact ? 0 : f->J); i++) {
        const int32_t taps = i < f->I ? f->N : f->M;
        correlate(part, theta, taps, history_of(f, i), f->B);
        add_to(i < f->I ? d : z, part, f->B);
        theta += taps;
    }
}

/* Return the mean power over a block of what the draws say the errors may be. */
static real power_of_doubt(const posterior *f)
{
    real *d = work_of(f, 1), *z = work_of(f, 2), doubt = 0;
    for (int32_t draw = 0; draw < DRAWS; draw++) {
        explain(f, f->draws + times(draw, f->n), d, z);
        add_scaled(d, -1, z, f->B);
        doubt += dot(d, d, f->B) / (real)f->B;
    }
    return doubt / (real)DRAWS;
}

/* Let the data go. */
static void forget_all(posterior *f)
{
    posterior_numbers *known = f->numbers;
    clear(f->G, times(f->padded, f->padded + PARTS) / 2);
    clear(f->r, times(f->K, f->n));
    clear(f->ee, (size_t)f->K);
    clear(known->fitted, 3);
    known->samples = 0;
    f->counts[PENDING] = 0;
}

/* Let the part of G that is sum v(t - i) u(t - c), i < n, c < m, fade and take the newest B
 * samples: along the diagonals of the sums, the window of t moves by one sample. On the diagonal of
 * G, v is u. */
static void add_products(posterior *f, int32_t B, const real *v, int32_t at_v, int32_t n,
                         const real *u, int32_t at_u, int32_t m, real sign, real forget)
{
    real *column = work_of(f, 2), *last = work_of(f, 3), *next = work_of(f, 4);
    correlate(column, u, B, v, n); /* c = 0 */
    if (v == u)
        last[0] = column[0];
    else
        correlate(last, v, B, u, m); /* i = 0 */
    real *restrict first = row_of_data(f, at_v) + at_u;
    for (int32_t c = 0; c < (v == u ? 1 : m); c++)
        first[c] = faded(first[c], forget, sign * last[c]);
    for (int32_t i = 1; i < n; i++) {
        const int32_t columns = v == u ? i + 1 : m;
        real *restrict row = row_of_data(f, at_v + i) + at_u, *restrict sums = next;
        const real *restrict before = last;
        const real gone = v[B + i - 1], come = v[i - 1];
        sums[0] = column[i];
        row[0] = faded(row[0], forget, sign * column[i]);
        for (int32_t c = 1; c < columns; c++) {
            const real sum = before[c - 1] + (gone * u[B + c - 1] - come * u[c - 1]);
            sums[c] = sum;
            row[c] = faded(row[c], forget, sign * sum);
        }
        next = last;
        last = sums;
    }
}

/* Let the data fade, and add the newest samples of the block. */
static void add_samples(posterior *f, int32_t newest, real forget)
{
    const int32_t regressors = f->I + (f->exact ? 0 : f->J), B = f->B;
    real *sums = work_of(f, 1);
    for (int i = 0; i < 3; i++) f->numbers->fitted[i] *= forget;
    f->numbers->samples = forget * f->numbers->samples + (real)newest;
    for (int32_t k = 0; k < f->K; k++) {
        const real *e = f->errors + times(k, B);
        f->ee[k] = forget * f->ee[k] + dot(e, e, newest);
    }
    for (int32_t a = 0, row = 0; a < regressors; a++) {
        const int32_t n = a < f->I ? f->N : f->M;
        const real sign = a < f->I ? 1 : -1;
        for (int32_t k = 0; k < f->K; k++) {
            real *restrict r = f->r + times(k, f->n) + row;
            correlate(sums, f->errors + times(k, B), newest, history_of(f, a), n);
            for (int32_t i = 0; i < n; i++) r[i] = faded(r[i], forget, sign * sums[i]);
        }
        for (int32_t b = 0, column = 0; b <= a; b++) {
            const int32_t m = b < f->I ? f->N : f->M;
            add_products(f, newest, history_of(f, a), row, n, history_of(f, b), column, m,
                         b < f->I ? sign : -sign, forget);
            column += m;
        }
        row += n;
    }
}

/* Energies of a block over the microphones, newest samples first: of what the posterior does not
 * explain, of d^ and of the errors. */
typedef struct { real *missed, *expected, heard; } judgement;

/* Judge a block. If s^ is exact, add what is played to the errors, because it teaches nothing. */
static judgement judge(posterior *f)
{
    const int32_t B = f->B;
    real *part = work_of(f, 0), *d = work_of(f, 1), *z = work_of(f, 2);
    judgement found = {.missed = work_of(f, 4), .expected = work_of(f, 5)};
    clear(found.missed, (size_t)B);
    clear(found.expected, (size_t)B);
    for (int32_t k = 0; k < f->K; k++) {
        real *error = f->errors + times(k, B);
        found.heard += dot(error, error, B);
        for (int32_t j = 0; f->exact && j < f->J; j++) {
            const real *path = f->path + times(k * f->J + j, f->M);
            correlate(part, path, f->M, history_of(f, f->I + j), B);
            add_to(error, part, B);
        }
        explain(f, f->theta + times(k, f->n), d, z);
        for (int32_t t = 0; t < B; t++) {
            const real missed = error[t] - d[t] + z[t];
            found.missed[t] += missed * missed;
            found.expected[t] += d[t] * d[t];
        }
    }
    return found;
}

static real sum_of(const real *a, int32_t n)
{
    real sum = 0;
    for (int32_t i = 0; i < n; i++) sum += a[i];
    return sum;
}

/* Return whether the loudspeakers sound in a block, or in what the secondary paths still hold. */
static int is_loud(const posterior *f)
{
    for (int32_t j = 0; j < f->J; j++) {
        const real *y = history_of(f, f->I + j);
        for (int32_t t = 0; t < f->B + f->M - 1; t++)
            if (y[t] != 0) return 1;
    }
    return 0;
}

/* Return the newest samples of a block that exceeds a limit, and belong to another plant: those
 * after the first eighth that exceeds it. */
static int32_t after_change(const posterior *f, const real *missed, real limit)
{
    for (int32_t i = 1;; i++) {
        const int32_t to = f->B - f->B * (i - 1) / EIGHTHS, from = f->B - f->B * i / EIGHTHS;
        if (i == EIGHTHS || sum_of(missed + from, to - from) > limit * (real)(to - from))
            return from;
    }
}

/* Forget all if the plant has changed. Return the number of the newest samples to learn from. */
static int32_t notice_surprise(posterior *f, const judgement *is, real q, real forget)
{
    posterior_numbers *known = f->numbers;
    const int32_t B = f->B, last = B - B * (EIGHTHS - 1) / EIGHTHS;
    const real each = (real)B * (real)f->K;
    const real missed = sum_of(is->missed, B), expected = sum_of(is->expected, B);
    int32_t newest = B;
    /* The noise grows with the disturbance, as it did before, and falls as fast as a sound dies
     * away that is longer than the paths. */
    known->loud = larger(expected, FADES * known->loud);
    const real noise =
        known->expected > 0 ? known->missed / known->expected * known->loud / each : 0;
    real limit = SURPRISE * larger(q, noise);
    if (missed > limit * each) limit += SURPRISE * (f->exact ? 0 : power_of_doubt(f));
    if (missed > limit * each) {
        const real in_last = sum_of(is->missed, last);
        const real foretold = FOREIGN * sum_of(is->expected, last);
        const real usual = explained(f) / known->samples * (real)last;
        /* What is over already, or has no part of x, tells nothing of the plant. */
        if (in_last <= limit * (real)last * (real)f->K || (in_last > foretold && usual > foretold))
            return 0;
        newest = after_change(f, is->missed, limit * (real)f->K);
        forget_all(f);
        count_up(f->alarms);
        known->spread = REDRAWN;
        f->counts[WAITING] = 1;
        f->counts[SILENT] = is->heard >= expected; /* the control does no good: listen to p alone */
    }
    known->missed = forget * known->missed + (missed < expected ? missed : expected);
    known->expected = forget * known->expected + expected;
    return newest;
}

/* Learn from a block whose errors are all known; at least as many samples as a primary path has
 * taps have been heard. */
static void learn_heard(posterior *f, real forget)
{
    const judgement is = judge(f);
    int32_t newest = f->B;
    /* Judged is what was fitted to data that include the loudspeakers, unless they are silent. */
    const int fitted = f->exact || f->numbers->fitted[2] > 0 || !is_loud(f);
    if (*f->fits && !f->counts[WAITING] && fitted)
        newest = notice_surprise(f, &is, mean_noise(f), forget);
    add_samples(f, newest, forget);
    if (!f->counts[PENDING] && newest == f->B && (f->counts[WAITING] || is_news(f))) begin_fit(f);
    if (f->counts[PENDING]) go_on_fitting(f);
}

void learn(posterior *f, real forget)
{
    if (!f->heard[MISSING] && f->heard[HEARD] >= f->N) learn_heard(f, forget);
    if (f->heard[HEARD] < 1 << 30) f->heard[HEARD] += f->B;
}

/* Set `to` to a with zeros around it, `more` on either side. */
static const real *widened(real *to, const real *a, int32_t n, int32_t more)
{
    clear(to, (size_t)more);
    copy(to + more, a, (size_t)n);
    clear(to + more + n, (size_t)more);
    return to;
}

static void reverse(real *restrict to, const real *restrict a, int32_t n)
{
    for (int32_t i = 0; i < n; i++) to[i] = a[n - 1 - i];
}

/* Add the weighted correlations of one theta, with a share of its p. */
static void expect_also(posterior *f, const real *theta, real weight, real of_p)
{
    const int32_t I = f->I, J = f->J, N = f->N, M = f->M;
    const real *s = theta + times(I, N);
    real *wide = work_of(f, 1), *sums = work_of(f, 2), *turned = work_of(f, 3);
    for (int32_t j = 0; j < J; j++)
        for (int32_t a = 0; a <= j; a++) {
            correlate(sums, s + times(a, M), M, widened(wide, s + times(j, M), M, M - 1),
                      2 * M - 1);
            add_scaled(f->ss + times(j * J + a, 2 * M - 1), weight, sums, 2 * M - 1);
        }
    for (int32_t i = 0; i < I; i++) {
        reverse(sums, theta + times(i, N), N);
        widened(wide, sums, N, M - 1);
        for (int32_t j = 0; j < J; j++) {
            reverse(turned, s + times(j, M), M);
            correlate(sums, turned, M, wide, N + M - 1);
            add_scaled(f->ps + times(i * J + j, N + M - 1), weight * of_p, sums, N + M - 1);
        }
    }
}

void expect(posterior *f)
{
    const int32_t I = f->I, J = f->J, N = f->N, M = f->M, lags = 2 * M - 1;
    const real share = (real)f->K / (real)DRAWS; /* the draws are of the mean noise */
    clear(f->ss, times(J * J, lags));
    clear(f->ps, times(I * J, N + M - 1));
    for (int32_t k = 0; k < f->K; k++) {
        const real *theta = f->theta + times(k, f->n);
        if (f->exact) { /* theta has no s: put it after p */
            real *both = f->sides;
            copy(both, theta, times(I, N));
            copy(both + times(I, N), f->path + times(k * J, M), times(J, M));
            theta = both;
        }
        expect_also(f, theta, 1, 1);
    }
    for (int32_t draw = 0; !f->exact && draw < DRAWS; draw++)
        expect_also(f, f->draws + times(draw, f->n), share, f->numbers->significant);
    for (int32_t j = 0; j < J; j++)
        for (int32_t a = 0; a < j; a++)
            reverse(f->ss + times(a * J + j, lags), f->ss + times(j * J + a, lags), lags);
    f->counts[STALE] = 0;
}
