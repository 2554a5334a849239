#include "posterior.h"

/* A surprise is an error beyond this many times the noise and the doubt: the error of a steady
 * recording reaches between seven and eight times its mean where the path is longer than the
 * model. */
static const real SURPRISE = 10;
/* rms error over the secondary path: if an independent one of the same size has replaced it,
 * sqrt(2); if the primary path alone has changed, so little that a drift of the primary path is not
 * taken for an error of both. */
static const real REDRAWN = (real)1.4142135623730951, HELD = (real)1e-3;
/* At a surprise, the loudspeakers play on only if they still reduce the power of the noise by this
 * factor: how much of what is left is due to a wrong s can only be told in silence. */
static const real PLAYS_ON = 6;
/* An error that is over before the last of so many parts of a block is a click or a clipped peak,
 * not another plant. */
enum { PARTS_OF_BLOCK = 8 };
/* Steps of conjugate gradients in a block. */
enum { PLANT_STEPS = 8 };

/* Layout. */

void layout_posterior(posterior *f, const signals *s, int32_t block, int exact, anc_layout *at)
{
    const int32_t K = s->K, J = s->J, I = s->I, M = s->M, N = s->L + M - 1;
    const int32_t C = I + (exact ? 0 : J), rows = K + (exact ? 0 : DRAWS);
    *f = (posterior){.K = K, .J = J, .I = I, .N = N, .M = M, .B = block, .exact = exact};
    f->n = I * N + (exact ? 0 : J * M);
    f->C = C;
    f->rows = rows;
    f->history = block + N - 1;
    f->path = s->path;
    layout_fourier(&f->fourier, N, at);
    const int32_t spectrum = f->fourier.F;
    f->numbers = structs(at, "posterior", ANC_STATE, 1, 1, 1, sizeof *f->numbers);
    f->counts = int32s(at, "posterior_counts", ANC_STATE, POSTERIOR_COUNTS);
    f->fits = int32s(at, "fits", ANC_STATE, 1);
    f->alarms = int32s(at, "alarms", ANC_STATE, 1);
    f->z = reals(at, "history", ANC_STATE, 1, 1, I + J, f->history);
    f->errors = reals(at, "block_errors", ANC_STATE, 1, 1, K, block);
    f->heard = int32s(at, "block_counts", ANC_STATE, BLOCK_COUNTS);
    f->theta = reals(at, "theta", ANC_STATE, 1, K, C, N);
    f->q = reals(at, "noise", ANC_STATE, 1, 1, 1, K);
    f->T = reals(at, "data", ANC_STATE, 1, C, C, N);
    f->r = reals(at, "data_of_errors", ANC_STATE, 1, rows, C, N);
    f->ee = reals(at, "error_energy", ANC_STATE, 1, 1, 1, K);
    f->before = reals(at, "before_data", ANC_STATE, 1, 1, C, N);
    f->solution = reals(at, "solution", ANC_STATE, 1, rows, C, N);
    f->prior = reals(at, "prior", ANC_STATE, 1, rows, C, N);
    f->T_at = reals(at, "data_spectra", ANC_SCRATCH, 1, C, C, spectrum);
    f->factor = reals(at, "data_factor", ANC_SCRATCH, 1, C, C, spectrum);
    f->ahead_at = reals(at, "newest_spectra", ANC_SCRATCH, 1, 1, C, spectrum);
    f->before_at = reals(at, "before_spectra", ANC_SCRATCH, 1, 1, C, spectrum);
    f->spectra = reals(at, "posterior_spectra", ANC_SCRATCH, 1, 1, C + 1, spectrum);
    f->products = reals(at, "posterior_products", ANC_SCRATCH, 1, 1, C, spectrum);
    f->taper = reals(at, "taper", ANC_SCRATCH, 1, 1, 1, f->history);
    f->faded = reals(at, "faded", ANC_SCRATCH, 1, 1, C, f->history);
    f->right = reals(at, "right_side", ANC_SCRATCH, 1, 1, C, N);
    f->vectors = reals(at, "posterior_vectors", ANC_SCRATCH, 1, 4, C, N);
    f->work = reals(at, "posterior_work", ANC_SCRATCH, 1, 1, POSTERIOR_ROWS, block);
}

static real *work_of(const posterior *f, int32_t row) { return f->work + times(row, f->B); }

/* Return the taps of signal c in a row of vectors. */
static real *taps_of(const posterior *f, real *vectors, int32_t row, int32_t c)
{
    return vectors + times(row * f->C + c, f->N);
}

/* Return how many taps signal c has. */
static int32_t taps_in(const posterior *f, int32_t c) { return c < f->I ? f->N : f->M; }

/* Return s^ of microphone k in place of signal c. */
static const real *given_path(const posterior *f, int32_t k, int32_t c)
{
    return f->path + times(k * f->J + c - f->I, f->M);
}

/* Return a random sign: the upper bit of a linear congruential generator. */
static real sign_of(int32_t *random)
{
    const uint32_t next = (uint32_t)*random * 1664525u + 1013904223u;
    memcpy(random, &next, sizeof next);
    return next >> 31 ? 1 : -1;
}

/* Expect the secondary paths to be what is believed of them. */
static void expect_learned(posterior *f)
{
    for (int32_t k = 0; k < f->K; k++)
        for (int32_t c = f->I; c < f->C; c++)
            copy(taps_of(f, f->prior, k, c), taps_of(f, f->theta, k, c), (size_t)f->M);
}

void start_posterior(posterior *f, real spread)
{
    f->numbers->spread = spread;
    f->numbers->significant = 1;
    f->counts[RANDOM] = 1;
    start_fourier(&f->fourier);
    for (int32_t k = 0; k < f->K; k++)
        for (int32_t c = f->I; c < f->C; c++)
            copy(taps_of(f, f->theta, k, c), given_path(f, k, c), (size_t)f->M);
    expect_learned(f);
    for (int32_t row = f->K; row < f->rows; row++)
        for (int32_t c = 0; c < f->C; c++)
            for (int32_t i = 0; i < f->N; i++) {
                const real sign = sign_of(f->counts + RANDOM);
                if (i < taps_in(f, c)) taps_of(f, f->prior, row, c)[i] = sign;
            }
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

/* A fit. */

/* Return the precision of the taps of signal c. */
static real precision_of(const posterior *f, int32_t c)
{
    return c < f->I ? f->numbers->precision : f->numbers->precision_s;
}

/* Return the energy in the data of the signals from `begin` to `end`, without the samples before
 * the first row, which are in the lags. */
static real energy_of_data(const posterior *f, int32_t begin, int32_t end)
{
    real energy = 0;
    for (int32_t c = begin; c < end; c++) {
        const real *before = f->before + times(c, f->N);
        energy += larger(f->T[times(c * f->C + c, f->N)] - dot(before, before, f->N), 0);
    }
    return energy;
}

/* Set the precisions: of the primary paths from |p|^2 = E[d^2 + e^2] / E[x^2] of the data of now.
 * Guess the first noise: -30 dB, which counts as n samples. Return 0 if nothing can be told yet. */
static int set_precisions(posterior *f)
{
    posterior_numbers *known = f->numbers;
    const real x2 = energy_of_data(f, 0, f->I);
    real e2 = 0, q = 0;
    for (int32_t k = 0; k < f->K; k++) {
        e2 += f->ee[k];
        q += f->q[k];
    }
    if (!(x2 > 0 && e2 > 0)) return 0;
    const real spread = known->spread;
    known->precision_s = f->exact ? 0 : (real)f->M / (spread * spread * size_of_path(f));
    known->precision = x2 * (real)f->N * (real)f->K / (e2 + known->explained);
    for (int32_t k = 0; q == 0 && k < f->K; k++) f->q[k] = (real)1e-3 * f->ee[k] / known->samples;
    return 1;
}

/* Take E'E t or S'S t off `out`, the spectra of T t. T: spectra of t; edge: spectra of the samples
 * at that end; only the products at lags from `from` to `until` - 1 count. `turn` is -1 for the
 * samples before the first row. */
static void leave_out(posterior *f, const real *edge, const real *T, real *out, int32_t from,
                      int32_t until, real turn)
{
    const fourier *F = &f->fourier;
    const size_t each = (size_t)F->F;
    real *sums = f->spectra + times(f->C, F->F), *rows = scratch_row(F, 2);
    clear(sums, each);
    for (int32_t c = 0; c < f->C; c++)
        add_product(F, sums, edge + (size_t)c * each, T + (size_t)c * each, 1, -turn);
    transform_back(F, rows, sums, until);
    clear(rows, (size_t)from);
    transform(F, sums, rows, until);
    for (int32_t c = 0; c < f->C; c++)
        add_product(F, out + (size_t)c * each, edge + (size_t)c * each, sums, -1, turn);
}

/* Set to = (G + q P) t; with q = 0, without the prior. */
static void multiply_data(posterior *f, real *to, const real *t, real q)
{
    const fourier *F = &f->fourier;
    const int32_t C = f->C, N = f->N;
    const size_t each = (size_t)F->F;
    real *T = f->spectra, *out = f->products;
    transform_rows(F, T, t, C, N);
    multiply_rows(F, out, f->T_at, T, C, C);
    leave_out(f, f->ahead_at, T, out, 1, N, 1);
    leave_out(f, f->before_at, T, out, 0, N - 1, -1);
    for (int32_t c = 0; c < C; c++) {
        const int32_t n = taps_in(f, c);
        const real ridge = q * precision_of(f, c);
        real *restrict sums = to + times(c, N);
        transform_back(F, sums, out + (size_t)c * each, n);
        for (int32_t i = 0; i < n; i++)
            sums[i] += ridge * f->taper[i] * f->taper[i] * t[times(c, N) + (size_t)i];
        for (int32_t i = n; i < N; i++) sums[i] = 0;
    }
}

static void multiply_posterior(void *self, real *to, const real *t)
{
    multiply_data(self, to, t, mean_noise(self));
}

static void precondition_posterior(void *self, real *to, const real *r)
{
    posterior *f = self;
    solve_circulants(&f->fourier, f->factor, f->spectra, to, r, f->C, f->N);
    for (int32_t c = f->I; c < f->C; c++)
        for (int32_t i = f->M; i < f->N; i++) to[times(c, f->N) + (size_t)i] = 0;
}

/* Set the spectra of the data. */
static void prepare(posterior *f, real q)
{
    const fourier *F = &f->fourier;
    const int32_t C = f->C, N = f->N;
    transform_all_lags(F, f->T_at, f->T, C, N, N, 0);
    transform_all_lags(F, f->factor, f->T, C, N, N, 1);
    for (int32_t c = 0; c < C; c++)
        add_white(F, f->factor + times(c * C + c, F->F), q * precision_of(f, c));
    factorise_spectra(F, f->factor, C);
    for (int32_t c = 0; c < C; c++) {
        transform(F, f->ahead_at + times(c, F->F), f->faded + times(c, f->history), N);
        transform(F, f->before_at + times(c, F->F), f->before + times(c, N), N - 1);
    }
}

/* Set the right side of a row, r + q P mean; at the first fit to new data, begin with the prior. */
static void set_right(posterior *f, int32_t row, real q)
{
    for (int32_t c = 0; c < f->C; c++) {
        const real *r = taps_of(f, f->r, row, c), *prior = taps_of(f, f->prior, row, c);
        const real ridge = q * precision_of(f, c);
        const real size = row < f->K ? 1 : 1 / root(larger(ridge, NEARLY_ZERO)); /* of a draw */
        real *restrict right = f->right + times(c, f->N), *t = taps_of(f, f->solution, row, c);
        for (int32_t i = 0; i < f->N; i++) {
            right[i] = r[i] + ridge * size * f->taper[i] * prior[i];
            if (f->counts[FRESH]) t[i] = size * prior[i] / f->taper[i];
        }
    }
}

/* Return the noise of a microphone from the residual, sum e^2 + theta'(G theta - 2 r). */
static real noise_of(posterior *f, int32_t k)
{
    const real samples = f->numbers->samples, n = (real)f->n;
    const real *t = taps_of(f, f->solution, k, 0), *r = taps_of(f, f->r, k, 0);
    const int32_t all = f->C * f->N;
    real *product = f->vectors;
    multiply_data(f, product, t, 0);
    const real residual = f->ee[k] + dot(t, product, all) - 2 * dot(t, r, all);
    /* A short record leaves little noise by chance: half of the taps of p count as fitted to noise,
     * and the earlier estimate as n samples. Below -60 dB, it could be rounding. */
    const real fitted = larger(samples - (real)(f->I * f->N) / 2, 0);
    const real noise = (larger(residual, 0) + n * f->q[k]) / (fitted + n);
    return larger(noise, (real)1e-6 * f->ee[k] / samples);
}

/* By chance alone, n taps explain n q. James and Stein: what is not significant is not played. */
static void keep_significant(posterior *f)
{
    const int32_t split = f->I * f->N, all = f->C * f->N;
    real explained = 0, *p = f->vectors, *product = f->vectors + all;
    for (int32_t k = 0; k < f->K; k++) {
        clear(p, (size_t)all);
        copy(p, taps_of(f, f->solution, k, 0), (size_t)split);
        multiply_data(f, product, p, 0);
        explained += dot(p, product, all);
    }
    const real chance = 2 * (real)split * (real)f->K * mean_noise(f);
    const real share = explained > chance ? 1 - chance / explained : 0;
    f->numbers->significant = share;
    f->numbers->explained = share * share * explained;
}

void path_of(const posterior *f, int32_t row, int32_t signal, real *to)
{
    if (signal >= f->C) { /* it is exact */
        copy(to, given_path(f, row, signal), (size_t)f->M);
        return;
    }
    const real drawn = row < f->K ? 1 : root((real)f->K / (real)DRAWS * mean_noise(f));
    const real share = signal < f->I ? f->numbers->significant * drawn : drawn;
    const real *t = taps_of(f, f->solution, row, signal);
    for (int32_t i = 0; i < taps_in(f, signal); i++) to[i] = share * f->taper[i] * t[i];
}

/* Approach the solution of a row. */
static void solve_row(posterior *f, int32_t row, real q)
{
    const equations own = {f, multiply_posterior, precondition_posterior, f->C * f->N, f->vectors};
    set_right(f, row, q);
    approach(&own, f->right, taps_of(f, f->solution, row, 0), PLANT_STEPS);
}

static void count_up(int32_t *count)
{
    if (*count < 1 << 30) ++*count;
}

/* Approach the posterior of the data; return 0 if nothing can be told yet. */
static int approach_posterior(posterior *f)
{
    if (!set_precisions(f)) return 0;
    const int32_t draws = f->rows - f->K;
    const real q = mean_noise(f), renewed = (real)(f->B * draws) / f->numbers->samples;
    prepare(f, q);
    for (int32_t k = 0; k < f->K; k++) solve_row(f, k, q);
    /* Draws take turns: all are solved again by the time that as many samples are new as the data
     * stand for. */
    for (int32_t i = 0; i < draws && (f->counts[FRESH] || (real)i < renewed); i++) {
        solve_row(f, f->K + f->counts[TURN], q);
        f->counts[TURN] = (f->counts[TURN] + 1) % draws;
    }
    for (int32_t k = 0; k < f->K; k++) f->q[k] = noise_of(f, k);
    /* Draws are over sqrt(q). If q rises, they keep their size, until they are solved with it. */
    const real scale = smaller(root(q / mean_noise(f)), 1);
    real *drawn = taps_of(f, f->solution, f->K, 0);
    for (int32_t i = 0; scale < 1 && i < draws * f->C * f->N; i++) drawn[i] *= scale;
    keep_significant(f);
    for (int32_t k = 0; k < f->K; k++)
        for (int32_t c = 0; c < f->C; c++) path_of(f, k, c, taps_of(f, f->theta, k, c));
    count_up(f->fits);
    f->counts[FRESH] = 0;
    return 1;
}

/* A block. */

void complete_sample(posterior *f, const real *error)
{
    const int32_t at = f->B - 1 - f->heard[FILLED];
    for (int32_t k = 0; error && k < f->K; k++) f->errors[times(k, f->B) + (size_t)at] = error[k];
    f->heard[MISSING] |= !error;
    f->heard[AWAITED] = 0;
    f->heard[FILLED]++;
}

void begin_block(posterior *f)
{
    f->heard[FILLED] = f->heard[MISSING] = 0;
    for (int32_t i = 0; i < f->I + f->J; i++) {
        real *z = history_of(f, i);
        memmove(z + f->B, z, sizeof(real) * (size_t)(f->history - f->B));
    }
}

/* Set the taper, and the faded signals. */
static void fade_signals(posterior *f, real forget)
{
    const real g = root(forget);
    real share = 1;
    for (int32_t i = 0; i < f->history; i++, share *= g) {
        f->taper[i] = share;
        for (int32_t c = 0; c < f->C; c++)
            f->faded[times(c, f->history) + (size_t)i] =
                (c < f->I ? share : -share) * history_of(f, c)[i];
    }
}

/* Return what the n newest faded samples count. */
static real count_of(const posterior *f, int32_t n) { return dot(f->taper, f->taper, n); }

static const real *faded_of(const posterior *f, int32_t c)
{
    return f->faded + times(c, f->history);
}

/* Set `to` to the faded response of a row to the signals from `begin` to `end`, in the n newest
 * samples. */
static void respond(const posterior *f, int32_t row, int32_t begin, int32_t end, int32_t n,
                    real *to)
{
    clear(to, (size_t)n);
    for (int32_t c = begin; c < end; c++)
        add_lags(&f->fourier, to, taps_of(f, f->solution, row, c), taps_in(f, c), faded_of(f, c),
                 n);
}

/* Return the mean power of the doubt in a faded block: that of the draws; without draws, what n
 * unknown taps add to the noise, and what part of d^ fewer samples than taps leave unknown. */
static real power_of_doubt(const posterior *f, real d2)
{
    const real q = mean_noise(f), samples = larger(f->numbers->samples, 1);
    real *heard = work_of(f, 0), doubt = 0;
    if (f->exact) return q * (real)f->n / samples + larger(1 - samples / (real)f->n, 0) * d2;
    for (int32_t row = f->K; row < f->rows; row++) {
        respond(f, row, 0, f->C, f->B, heard);
        doubt += dot(heard, heard, f->B);
    }
    return q * doubt / ((real)DRAWS * count_of(f, f->B));
}

/* Let the data go, and begin with the newest samples of the block. */
static void begin_data(posterior *f, int32_t newest)
{
    const int32_t C = f->C, N = f->N;
    posterior_numbers *known = f->numbers;
    clear(f->T, times(C * C, N));
    clear(f->r, times(f->rows * C, N));
    clear(f->ee, (size_t)f->K);
    known->samples = known->explained = 0;
    f->counts[BEGUN] = f->counts[FRESH] = 1;
    /* The N - 1 samples before the first row are in the lags. */
    real *reversed = f->vectors;
    clear(reversed, times(C, 2 * N));
    for (int32_t c = 0; c < C; c++) {
        real *before = f->before + times(c, N), *turned = reversed + times(c, 2 * N);
        for (int32_t i = 0; i < N - 1; i++)
            before[N - 2 - i] = turned[i] =
                (c < f->I ? 1 : -1) * f->taper[i] * history_of(f, c)[newest + i];
    }
    add_all_lags(&f->fourier, f->T, reversed, C, 2 * N, N, N);
}

/* Let numbers fade. */
static void let_fade(real *sums, size_t n, real share)
{
    for (size_t i = 0; i < n; i++) sums[i] = faded(sums[i], share, 0);
}

/* Set `heard` to what a row hears in the newest samples: the errors, which `judge` has faded, or a
 * draw's unit noise. If they are not believed, it hears what it expects, which changes nothing. */
static void hear_row(posterior *f, int32_t row, int32_t newest, int believed, real *heard)
{
    if (!believed)
        respond(f, row, 0, f->C, newest, heard);
    else if (row < f->K)
        copy(heard, f->errors + times(row, f->B), (size_t)newest);
    else
        for (int32_t t = 0; t < newest; t++) heard[t] = sign_of(f->counts + RANDOM);
}

/* Let the data fade, and add the newest samples of the block, whose d^ has the energy `expected`.
 */
static void add_samples(posterior *f, int32_t newest, int believed, real expected, real forget)
{
    const int32_t C = f->C, N = f->N;
    const real share = raised(forget, newest);
    posterior_numbers *known = f->numbers;
    real *heard = work_of(f, 0);
    const real count = count_of(f, newest);
    let_fade(f->before, times(C, N), root(share));
    let_fade(f->T, times(C * C, N), share);
    let_fade(f->r, times(f->K * C, N), share);
    let_fade(taps_of(f, f->r, f->K, 0), times((f->rows - f->K) * C, N), root(share));
    add_all_lags(&f->fourier, f->T, f->faded, C, f->history, newest, N);
    for (int32_t row = 0; row < f->rows; row++) {
        hear_row(f, row, newest, believed, heard);
        for (int32_t c = 0; c < C; c++)
            add_lags(&f->fourier, taps_of(f, f->r, row, c), heard, newest, faded_of(f, c),
                     taps_in(f, c));
        if (row >= f->K) continue;
        const real noise = believed ? 0 : f->q[row] * count; /* which it expects, too */
        f->ee[row] = share * f->ee[row] + dot(heard, heard, newest) + noise;
    }
    known->samples = share * known->samples + count;
    known->explained = share * known->explained + expected;
}

/* Return how many samples are the last part of a block. */
static int32_t last_part(const posterior *f)
{
    return f->B - f->B * (PARTS_OF_BLOCK - 1) / PARTS_OF_BLOCK;
}

/* Energies of a faded block over the microphones: of what the posterior does not explain, in all
 * and at last, and of d^; and of the errors, before they fade. */
typedef struct { real missed, missed_at_last, expected, heard; } judgement;

/* Judge a block. Its errors are overwritten: they fade, and if s^ is exact, what is played is
 * added, because it teaches nothing. */
static judgement judge(posterior *f)
{
    const int32_t B = f->B;
    real *d = work_of(f, 0), *z = work_of(f, 1);
    judgement found = {0};
    for (int32_t k = 0; k < f->K; k++) {
        real *error = f->errors + times(k, B);
        found.heard += dot(error, error, B);
        for (int32_t j = 0; f->exact && j < f->J; j++) {
            const real *path = f->path + times(k * f->J + j, f->M);
            add_lags(&f->fourier, error, path, f->M, history_of(f, f->I + j), B);
        }
        respond(f, k, 0, f->I, B, d);
        respond(f, k, f->I, f->C, B, z);
        for (int32_t t = 0; t < B; t++) {
            error[t] *= f->taper[t];
            d[t] *= f->numbers->significant;
            z[t] = error[t] - d[t] - z[t];
        }
        found.missed += dot(z, z, B);
        found.missed_at_last += dot(z, z, last_part(f));
        found.expected += dot(d, d, B);
    }
    return found;
}

/* Return the rms error over the secondary paths that is left, by the draws. Of an exact path,
 * nothing is learned. */
static real doubt_of_paths(const posterior *f)
{
    real sum = 0, *path = f->right;
    if (f->exact) return f->numbers->spread;
    for (int32_t row = f->K; row < f->rows; row++)
        for (int32_t c = f->I; c < f->C; c++) {
            path_of(f, row, c, path);
            sum += dot(path, path, f->M);
        }
    return root(sum / ((real)(f->K * f->J) * size_of_path(f)));
}

/* Return whether a block is to be believed. Forget all if it tells of another plant. */
static int notice_surprise(posterior *f, const judgement *is, real forget)
{
    posterior_numbers *known = f->numbers;
    const real count = count_of(f, f->B), each = count * (real)f->K;
    /* The noise grows with the disturbance, as it did before. On trial, what was missed holds the
     * surprise, and would hide a wrong s. */
    const real grown =
        known->expected > 0 ? known->missed / known->expected * is->expected / each : 0;
    const int on_trial = f->counts[ON_TRIAL];
    const real noise = on_trial ? mean_noise(f) : larger(mean_noise(f), grown);
    int surprised = is->missed > SURPRISE * noise * each;
    if (surprised) {
        real doubt = power_of_doubt(f, is->expected / each);
        /* After a block that is shorter than p, the doubt would hide a wrong s, too. */
        if (on_trial) doubt = smaller(doubt, is->expected / (SURPRISE * SURPRISE * each));
        const real limit = SURPRISE * (noise + doubt);
        surprised = is->missed > limit * each;
        if (surprised && is->missed_at_last <= limit * count_of(f, last_part(f)) * (real)f->K)
            return 0;
    }
    f->counts[ON_TRIAL] = 0;
    /* With fewer samples than taps, what is missed is not learned yet, and no noise. */
    if (known->samples > (real)f->n) {
        const real share = raised(forget, f->B);
        known->missed = share * known->missed + smaller(is->missed, is->expected);
        known->expected = share * known->expected + is->expected;
    }
    if (!surprised) return 1;
    count_up(f->alarms);
    f->counts[WAITING] = 1;
    const real heard = is->heard / (real)f->B, expected = is->expected / count;
    f->counts[SILENT] = PLAYS_ON * heard >= expected;
    const int learned = 2 * doubt_of_paths(f) < known->spread;
    if (learned) expect_learned(f);
    /* If the control does any good, s is as it was learned; not if it is held already, because this
     * surprise contradicts that. */
    if (heard >= expected || known->spread <= HELD)
        known->spread = REDRAWN;
    else if (learned) {
        known->spread = HELD;
        f->counts[ON_TRIAL] = 1;
    }
    begin_data(f, 0);
    return 0;
}

/* Return the energy of a block of the signals from `begin` to `end`. */
static real energy_of_block(const posterior *f, int32_t begin, int32_t end)
{
    real energy = 0;
    for (int32_t c = begin; c < end; c++) energy += dot(faded_of(f, c), faded_of(f, c), f->B);
    return energy;
}

/* Return whether the data have told little about p, and the noise in which they were heard has
 * gone. */
static int noise_has_gone(const posterior *f, const judgement *is)
{
    const real noise = mean_noise(f) * count_of(f, f->B) * (real)f->K;
    return 2 * f->numbers->significant < 1 && LOUDER * LOUDER * is->missed < noise && is->heard > 0;
}

/* Learn from the newest samples of a block; 0: its errors are not known. */
static void learn_samples(posterior *f, int32_t newest, real forget)
{
    const int known = *f->fits && !f->counts[WAITING];
    fade_signals(f, forget);
    if (!f->counts[BEGUN] || (!newest && !known)) begin_data(f, newest);
    if (!newest && !known) return;
    const judgement is = judge(f);
    int32_t believed = newest;
    if (newest && known && !notice_surprise(f, &is, forget)) believed = 0;
    const real x2 = energy_of_block(f, 0, f->I), y2 = energy_of_block(f, f->I, f->C);
    const real x2_of_data = energy_of_data(f, 0, f->I), y2_of_data = energy_of_data(f, f->I, f->C);
    if (believed) {
        const int noise_gone = known && x2 > 0 && noise_has_gone(f, &is);
        if (noise_gone) clear(f->q, (size_t)f->K); /* it is guessed anew */
        if (noise_gone || x2 > LOUDER * x2_of_data)
            begin_data(f, believed); /* what the data told is little */
        add_samples(f, believed, 1, is.expected, forget);
    } else if (!f->counts[WAITING]) {
        if (x2 >= x2_of_data || y2 > y2_of_data || !(f->numbers->samples > 0))
            begin_data(f, 0); /* the block would stand for more than is known */
        else
            add_samples(f, f->B, 0, is.expected, forget);
    }
    if (believed && approach_posterior(f) && believed == f->B)
        f->counts[WAITING] = f->counts[SILENT] = 0;
}

/* Return whether the references have set in after silence. It may have been a fault of theirs: what
 * is in the delay lines is not known then. */
static int have_set_in(const posterior *f)
{
    const int32_t B = f->B, n = f->N - 1;
    real block = 0, before = 0;
    for (int32_t i = 0; i < f->I; i++) {
        const real *x = history_of(f, i);
        block += dot(x, x, B);
        before += dot(x + B, x + B, n);
    }
    return block * (real)n > LOUDER * LOUDER * before * (real)B;
}

void learn(posterior *f, real forget)
{
    if (f->heard[HEARD] < 1 << 30) f->heard[HEARD] += f->B;
    if (f->counts[BEGUN] && have_set_in(f)) f->heard[HEARD] = 0;
    /* Rows whose delay lines are known; at first, as many as a path has taps. */
    const int32_t rows = f->heard[HEARD] - f->N, least = f->counts[BEGUN] ? f->B : f->N;
    int32_t newest = 0;
    if (!f->counts[BEGUN] && rows < least) return;
    if (!f->heard[MISSING] && rows >= least) newest = rows < f->B ? rows : f->B;
    learn_samples(f, newest, forget);
}
