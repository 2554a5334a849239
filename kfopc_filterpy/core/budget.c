/* KF-PB: a posterior of the plant, the control filters of least expected error, and a price of
 * power for each loudspeaker.
 *
 *     y = v * x            asked of the loudspeakers
 *     e = p * x - s * y    heard by the microphones, and noise
 *
 * After every block of B samples, the posterior of p and s takes the block (posterior.c). Then the
 * filters of all loudspeakers become those of least expected error at the prices of their powers,
 * (A + price R) v = b: A is the correlation of the filtered references, R that of the references, b
 * theirs with the disturbance. Both are Toeplitz for each pair of filters. A few steps of conjugate
 * gradients from the last solution approach the filters, and a step near to Newton's the prices.
 * N = L + M - 1 taps of a primary path are all that control can reach. */
#include "posterior.h"

enum { RATED_POWER, BLOCK, AVERAGING, WINDOW, MEMORY, SPREAD };
static const anc_setting budget_settings[] = {{"rated_power", 1e-30f, 0, ANC_EACH_LOUDSPEAKER},
                                              {"block", 1, 65536, ANC_ONE},
                                              {"averaging", 20, 100000, ANC_ONE},
                                              {"window", 0, 1, ANC_ONE},
                                              {"memory", 0, 1, ANC_ONE},
                                              {"spread", 0, 1000, ANC_ONE},
                                              {0}};

/* In ratings: the mean power that is planned for a short time, a little more than 1, since a noise
 * that fluctuates spends less; the mean over the account beyond which samples are clipped. */
static const real PLANNED = (real)1.02, MOST = (real)1.04;
/* A noise may go on as in the window of x for this part of the averaging time, and as in the last
 * block for this one. */
enum { WINDOW_LASTS = 5, BLOCK_LASTS = 20 };
/* Windows of levels. USUAL is that of R, RECENT the same without pauses, and LATE the averaging
 * time without pauses. NOW is so much shorter than that of R: a spectrum needs many samples, a
 * level few. */
enum { NOW, USUAL, RECENT, LATE, LEVELS };
enum { SHORTER = 5 };
/* A sound does not grow by more than this from one sample to the next, but a click does. */
static const real GROWTH = 10;
/* Steps of conjugate gradients towards filters. */
enum { FILTER_STEPS = 12 };
/* Share of the paths' gains that is added to the prices. Short filters leak about as much into
 * directions in which their spectra have none: with less, filters follow a price slowly there, and
 * play what hardly reduces the error; with more, prices swing. */
static const real LEAKED = (real)1e-4;
/* No filter has a larger tap. REGULAR: share of the powers of x that is added to them, so that
 * rounding leaves the matrix definite. */
#ifdef ANC_FLOAT
static const real LARGEST_TAP = 1e6f, REGULAR = 1e-5f, LEAST_POWER = 1e-30f;
#else
static const real LARGEST_TAP = 1e50, REGULAR = 1e-7, LEAST_POWER = 1e-300;
#endif

typedef struct {
    signals s;
    posterior posterior;
    int32_t T;                /* blocks of the account */
    real *asked;              /* (3, J) now; sum of squares of the block; the most it may become */
    real *peak;               /* (I + K) largest magnitudes of x and e of late */
    int32_t *controlled;      /* whether control was on in the block */
    real *R;                  /* (I, I, N) windowed sums of x_i(t) x_a(t - l) */
    real *levels, *weight;    /* (LEVELS) windowed sums of mean squares of x in blocks; (LEVELS) */
    int32_t *pause;           /* blocks of the present one so far */
    real *book;               /* (T, J) power of each block over the rating, newest first */
    real *price;              /* (J) */
    real *now;                /* (J, I, L) filters at these prices */
    real *lags;               /* (I, I, N) of the window, into which the newest block fades in */
    real *R_at, *smooth_R;    /* (I, I) spectra: of the lags, of a circulant near to them */
    real *SS, *gain;          /* (J, J) spectra of the secondary paths; (J) mean of the diagonal */
    real *factor;             /* (J, I, J, I) spectra: factor of a matrix near to A + price R */
    real *b;                  /* (J, I, L) */
    real *spectra, *products; /* (J, I), (J, I) spectra */
    real *vectors;            /* (4, J, I, L) */
    real *small;              /* (3, J) slopes, powers, and what is afforded */
    real *window;             /* (I, B + N - 1) */
    real *work;               /* of a path, (N), or of a block, (B) */
} budget;
typedef char budget_fits_into_a_view[sizeof(budget) <= sizeof(anc_view) ? 1 : -1];

/* Layout. */

/* Return whether the algorithm takes the plan, so that all products of counts below fit into an
 * int32. */
static int takes(const anc_plan *p, real block, real averaging)
{
    const double most = 1 << 28, B = block, T = averaging;
    const double K = p->microphones, J = p->loudspeakers, I = p->references;
    const double L = p->taps, M = p->path_taps, N = L + M - 1, spectrum = 4 * N + 2;
    if (p->guard_taps || p->scenarios != 1) return 0;
    if (!(B >= 1 && B <= 65536 && T >= (double)BLOCK_LASTS && T <= 100000 && N <= 1 << 20))
        return 0;
    return (K + (double)DRAWS) * (I + J) * N <= most && J * T <= most &&
           (I + J + K) * (2 * N + B) <= most && (I + J + 1) * (I + J) * spectrum <= most &&
           J * I * J * I * spectrum <= most && 4 * J * I * L <= most;
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
    const int32_t I = s->I, L = s->L, N = f->posterior.N, B = f->posterior.B;
    const int32_t spectrum = f->posterior.fourier.F;
    f->T = (int32_t)averaging;
    f->asked = reals(at, "asked", ANC_STATE, 1, 1, 3, J);
    f->peak = reals(at, "peaks", ANC_STATE, 1, 1, 1, I + s->K);
    f->controlled = int32s(at, "controlled", ANC_STATE, 1);
    f->R = reals(at, "reference_correlation", ANC_STATE, 1, I, I, N);
    f->levels = reals(at, "levels", ANC_STATE, 1, 1, 1, LEVELS);
    f->weight = reals(at, "level_weights", ANC_STATE, 1, 1, 1, LEVELS);
    f->pause = int32s(at, "pause", ANC_STATE, 1);
    f->book = reals(at, "book", ANC_STATE, 1, 1, f->T, J);
    f->price = reals(at, "price", ANC_STATE, 1, 1, 1, J);
    f->now = reals(at, "filters", ANC_STATE, 1, J, I, L);
    f->lags = reals(at, "lags", ANC_SCRATCH, 1, I, I, N);
    f->R_at = reals(at, "reference_spectra", ANC_SCRATCH, 1, I, I, spectrum);
    f->smooth_R = reals(at, "smooth_reference_spectra", ANC_SCRATCH, 1, I, I, spectrum);
    f->SS = reals(at, "path_spectra", ANC_SCRATCH, 1, J, J, spectrum);
    f->gain = reals(at, "path_gains", ANC_SCRATCH, 1, 1, 1, J);
    f->factor = reals(at, "priced_factor", ANC_SCRATCH, J * I, J, I, spectrum);
    f->b = reals(at, "with_disturbance", ANC_SCRATCH, 1, J, I, L);
    f->spectra = reals(at, "filter_spectra", ANC_SCRATCH, 1, J, I, spectrum);
    f->products = reals(at, "filter_products", ANC_SCRATCH, 1, J, I, spectrum);
    f->vectors = reals(at, "filter_vectors", ANC_SCRATCH, 4, J, I, L);
    f->small = reals(at, "of_loudspeakers", ANC_SCRATCH, 1, 1, 3, J);
    f->window = reals(at, "windowed", ANC_SCRATCH, 1, 1, I, B + N - 1);
    f->work = reals(at, "budget_work", ANC_SCRATCH, 1, 1, 1, B > N ? B : N);
}

/* Set what each loudspeaker may spend in the next block, whatever its filter asks for. */
static void set_room(budget *f)
{
    const int32_t J = f->s.J;
    for (int32_t j = 0; j < J; j++) {
        real spent = 0;
        for (int32_t t = 0; t < f->T; t++) spent += f->book[times(t, J) + (size_t)j];
        const real left = larger(MOST * (real)f->T - spent, 0);
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

/* The references. */

/* Take the block into the levels. After a soft time, a level is that of the loud block at once. A
 * block that is LOUDER^2 times softer than the recent level is a pause, for at most T blocks. */
static void take_levels(budget *f)
{
    const int32_t B = f->posterior.B;
    const real g = raised(*f->s.setting[WINDOW], B);
    const real fade[LEVELS] = {raised(g, SHORTER), g, g, 1 - 1 / (real)f->T};
    real block = 0;
    for (int32_t i = 0; i < f->s.I; i++) {
        const real *x = history_of(&f->posterior, i);
        block += dot(x, x, B) / (real)B;
    }
    const int soft = LOUDER * LOUDER * block * f->weight[RECENT] < f->levels[RECENT];
    const int stays_soft = soft && *f->pause >= f->T;
    *f->pause = soft && *f->pause < f->T ? *f->pause + 1 : 0;
    for (int w = 0; w < LEVELS; w++) {
        real *sum = f->levels + w, *weight = f->weight + w;
        if (w > USUAL && *f->pause) continue;
        if (block * *weight > LOUDER * *sum || (w > USUAL && stays_soft)) {
            *weight = 1;
            *sum = block;
        }
        *sum = faded(*sum, fade[w], block);
        *weight = fade[w] * *weight + 1;
    }
}

static real level_of(const budget *f, int w) { return f->levels[w] / f->weight[w]; }

/* Return a level over another one, 1 in silence. */
static real levels_over(const budget *f, int a, int b)
{
    return f->levels[b] > 0 ? level_of(f, a) / level_of(f, b) : 1;
}

/* Add the lags of the block, which fades by `slow` a sample, to sums, (I, I, N); it may fade in. */
static void add_block(budget *f, real *sums, real slow, int fades_in)
{
    const int32_t I = f->s.I, N = f->posterior.N, B = f->posterior.B, length = B + N - 1;
    real share = 1;
    for (int32_t t = 0; t < length; t++, share *= slow) {
        const real from_begin = ((real)(B - t) - (real)0.5) / (real)B;
        const real fade_in = fades_in && t < B ? 1 - from_begin * from_begin : 1;
        for (int32_t i = 0; i < I; i++)
            f->window[times(i, length) + (size_t)t] =
                share * fade_in * history_of(&f->posterior, i)[t];
    }
    add_all_lags(&f->posterior.fourier, sums, f->window, I, length, B, N);
}

/* Add the block to the window of the references. Set the lags to those of a window into which the
 * newest block fades in: without its edge, on which a filter would ring. Both are lags of one faded
 * signal, hence positive definite. Their mean square is the usual level. */
static void take_references(budget *f)
{
    const int32_t I = f->s.I, N = f->posterior.N;
    const real g = *f->s.setting[WINDOW], fade = raised(g, f->posterior.B), slow = root(g);
    for (size_t n = 0; n < times(I * I, N); n++) f->lags[n] = f->R[n] = faded(f->R[n], fade, 0);
    add_block(f, f->lags, slow, 1);
    add_block(f, f->R, slow, 0);
    real sum = 0;
    for (int32_t i = 0; i < I; i++) sum += f->lags[times(i * I + i, N)];
    const real scale = sum > 0 ? level_of(f, USUAL) / sum : 0;
    for (size_t n = 0; n < times(I * I, N); n++) f->lags[n] *= scale;
}

/* Set the spectra of n lags, with some white noise. */
static void transform_references(budget *f, real *spectra, int32_t n, int smooth)
{
    const int32_t I = f->s.I, N = f->posterior.N;
    const fourier *F = &f->posterior.fourier;
    transform_all_lags(F, spectra, f->lags, I, N, n, smooth);
    for (int32_t ii = 0; ii < I * I; ii += I + 1)
        add_white(F, spectra + times(ii, F->F), REGULAR * f->lags[times(ii, N)]);
}

/* The equations. */

/* Set the spectra of the paths over the posterior: of secondary ones with each other, and of
 * primary ones with these, (J, I), in the products. */
static void correlate_paths(budget *f)
{
    const int32_t I = f->s.I, J = f->s.J, M = f->s.M, N = f->posterior.N;
    const fourier *F = &f->posterior.fourier;
    const size_t each = (size_t)F->F;
    real *path = f->work, *P = scratch_row(F, 4);
    clear(f->SS, times(J * J, F->F));
    clear(f->products, times(J * I, F->F));
    for (int32_t row = 0; row < f->posterior.rows; row++) {
        for (int32_t j = 0; j < J; j++) {
            path_of(&f->posterior, row, I + j, path);
            transform(F, f->spectra + (size_t)j * each, path, M);
        }
        for (int32_t j = 0; j < J; j++)
            for (int32_t a = 0; a < J; a++)
                add_product(F, f->SS + times(j * J + a, F->F), f->spectra + (size_t)j * each,
                            f->spectra + (size_t)a * each, 1, -1);
        for (int32_t c = 0; c < I; c++) {
            path_of(&f->posterior, row, c, path);
            transform(F, P, path, N);
            for (int32_t j = 0; j < J; j++)
                add_product(F, f->products + times(j * I + c, F->F), f->spectra + (size_t)j * each,
                            P, 1, -1);
        }
    }
}

/* Set b, and the gains of the paths. */
static void set_equations(budget *f)
{
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L;
    const fourier *F = &f->posterior.fourier;
    real *sums = f->spectra;
    correlate_paths(f);
    for (int32_t j = 0; j < J; j++) {
        multiply_rows(F, sums, f->R_at, f->products + times(j * I, F->F), I, I);
        transform_rows_back(F, f->b + times(j * I, L), sums, I, L);
        transform_back(F, f->gain + j, f->SS + times(j * J + j, F->F), 1);
    }
}

/* Return the price in the equations. */
static real price_of(const budget *f, int32_t j) { return f->price[j] + LEAKED * f->gain[j]; }

/* Set to = (A + price R) v for all filters. */
static void multiply_filters(void *self, real *to, const real *v)
{
    budget *f = self;
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L;
    const fourier *F = &f->posterior.fourier;
    real *sums = scratch_row(F, 2);
    transform_rows(F, f->spectra, v, J * I, L);
    for (int32_t a = 0; a < J; a++)
        multiply_rows(F, f->products + times(a * I, F->F), f->R_at, f->spectra + times(a * I, F->F),
                      I, I);
    for (int32_t j = 0; j < J; j++)
        for (int32_t i = 0; i < I; i++) {
            const real *own = f->products + times(j * I + i, F->F);
            const real price = price_of(f, j);
            for (int32_t k = 0; k < F->F; k++) sums[k] = price * own[k];
            for (int32_t a = 0; a < J; a++)
                add_product(F, sums, f->SS + times(j * J + a, F->F),
                            f->products + times(a * I + i, F->F), 1, 1);
            transform_back(F, to + times(j * I + i, L), sums, L);
        }
}

static void precondition_filters(void *self, real *to, const real *r)
{
    budget *f = self;
    solve_circulants(&f->posterior.fourier, f->factor, f->spectra, to, r, f->s.J * f->s.I, f->s.L);
}

/* Factorise (SS + price) R at each frequency, with a smooth R. With more loudspeakers than
 * microphones, SS leaves directions of v open, as A nearly does: the price decides there. */
static void factorise_filters(budget *f)
{
    const int32_t I = f->s.I, J = f->s.J;
    const fourier *F = &f->posterior.fourier;
    for (int32_t ji = 0; ji < J * I; ji++)
        for (int32_t ac = 0; ac <= ji; ac++) {
            const int32_t j = ji / I, i = ji % I, a = ac / I, c = ac % I;
            const real *R = f->smooth_R + times(i * I + c, F->F);
            real *at = f->factor + times(ji * J * I + ac, F->F);
            multiply_rows(F, at, f->SS + times(j * J + a, F->F), R, 1, 1);
            if (j == a) add_scaled(at, price_of(f, j), R, F->F);
        }
    factorise_spectra(F, f->factor, J * I);
}

/* Go some steps from the last filters towards those at the prices. */
static void solve_filters(budget *f)
{
    const int32_t n = f->s.J * f->s.I * f->s.L;
    const equations own = {f, multiply_filters, precondition_filters, n, f->vectors};
    factorise_filters(f);
    approach(&own, f->b, f->now, FILTER_STEPS);
    for (int32_t i = 0; i < n; i++)
        if (!within(f->now[i], LARGEST_TAP)) {
            clear(f->now, (size_t)n);
            return;
        }
}

/* The prices. */

/* Set the powers of the filters; u_j = R v_j are left in the vectors. */
static void set_powers(budget *f, real *power)
{
    const int32_t I = f->s.I, L = f->s.L;
    const fourier *F = &f->posterior.fourier;
    for (int32_t j = 0; j < f->s.J; j++) {
        const real *own = f->now + times(j, I * L);
        real *u = f->vectors + times(j, I * L);
        transform_rows(F, f->spectra, own, I, L);
        multiply_rows(F, f->products, f->R_at, f->spectra, I, I);
        transform_rows_back(F, u, f->products, I, L);
        power[j] = dot(u, own, I * L);
    }
}

/* Set the sums over a of |u_j'A^-1 u_a|, with the preconditioner in place of A + price R. */
static void set_slopes(budget *f, real *slope)
{
    const int32_t I = f->s.I, J = f->s.J, L = f->s.L;
    const fourier *F = &f->posterior.fourier;
    clear(slope, (size_t)J);
    transform_rows(F, f->products, f->vectors, J * I, L);
    for (int32_t a = 0; a < J; a++) {
        clear(f->spectra, times(J * I, F->F));
        copy(f->spectra + times(a * I, F->F), f->products + times(a * I, F->F), times(I, F->F));
        solve_spectra(F, f->factor, f->spectra, J * I);
        for (int32_t j = 0; j < J; j++) {
            const size_t at = times(j * I, F->F);
            const real h = dot(f->products + at, f->spectra + at, I * F->F) * 2 / (real)F->F;
            slope[j] += h < 0 ? -h : h;
        }
    }
}

/* Move the prices towards the targets, and return whether one has changed. power^-1/2 is nearly a
 * line in a price, with the slope power^-3/2 u'A^-1 u. For u'A^-1 u stands the sum of sizes in its
 * row, so that no price goes too far if all move. */
static int next_prices(budget *f, const real *power, const real *target)
{
    real *slope = f->small;
    int changed = 0;
    set_slopes(f, slope);
    for (int32_t j = 0; j < f->s.J; j++) {
        const real last = f->price[j], over = power[j] * (root(power[j] / target[j]) - 1);
        const real next = larger(last + over / larger(slope[j], LEAST_POWER), 0);
        f->price[j] = next < (real)1e-9 * f->gain[j] ? 0 : next;
        changed |= f->price[j] != last;
    }
    return changed;
}

/* The account. */

/* Return the mean power of the filter v, (I, L), in the present block. */
static real power_of_block(const budget *f, const real *v)
{
    const int32_t L = f->s.L, B = f->posterior.B;
    real *y = f->work;
    clear(y, (size_t)B);
    for (int32_t i = 0; i < f->s.I; i++)
        add_lags(&f->posterior.fourier, y, v + times(i, L), L, history_of(&f->posterior, i), B);
    return dot(y, y, B) / (real)B;
}

/* Return the power that loudspeaker j's account can afford, if the noise goes on: as in the last
 * block, where its filter has another power, for a short time; as in the window of x, for longer;
 * and then at the lower one of the levels of now, over the usual one, and of late, over the recent
 * one. So what a silence has saved is spent evenly, and the price hardly follows a noise that
 * fluctuates. */
static real affordable(const budget *f, int32_t j, real power)
{
    const int32_t T = f->T, block = T / BLOCK_LASTS, window = T / WINDOW_LASTS;
    const real of_block = power_of_block(f, f->now + times(j, f->s.I * f->s.L));
    const real in_block = of_block > 0 && power > 0 ? of_block / power : 1;
    const real later = smaller(levels_over(f, NOW, USUAL), levels_over(f, LATE, RECENT));
    real spent = 0, least = 0;
    for (int32_t n = T - 1; n >= block; n--) { /* spent, and still counted n blocks from now */
        spent += f->book[times(T - 1 - n, f->s.J) + (size_t)j];
        const int longer = n > window && n <= T - block;
        if (!longer && n != window && n != block) continue;
        const real left = (longer ? 1 : PLANNED) * (real)T - spent;
        const real level = longer ? later : n == window ? 1 : in_block;
        const real each = larger(left / (real)n, PLANNED - 1) / level;
        if (least == 0 || each < least) least = each;
    }
    return least * f->s.setting[RATED_POWER][j];
}

/* Set the filters of least expected error at the prices, their powers, and those that the accounts
 * afford. */
static void solve_at_prices(budget *f, real *power, real *afforded)
{
    solve_filters(f);
    set_powers(f, power);
    for (int32_t j = 0; j < f->s.J; j++) afforded[j] = affordable(f, j, power[j]);
}

/* Set the prices at which the accounts afford the filters. What a step leaves is taken off. */
static void solve_all(budget *f)
{
    const int32_t J = f->s.J, n = f->s.I * f->s.L;
    real *power = f->small + J, *afforded = power + J;
    set_equations(f);
    solve_at_prices(f, power, afforded);
    if (next_prices(f, power, afforded)) solve_at_prices(f, power, afforded);
    for (int32_t j = 0; j < J; j++) {
        const real share = power[j] > afforded[j] ? root(afforded[j] / power[j]) : 1;
        for (int32_t i = 0; i < n; i++)
            weights_of(&f->s, j)[i] = share * f->now[times(j, n) + (size_t)i];
    }
}

/* A sample. */

static int is_too_loud(const signals *s, const real *reference)
{
    for (int32_t i = 0; i < s->I; i++) {
        const real x = reference_of(s, reference, i);
        if (!within(x, anc_loudest_learnt) || !within(x, *s->loudest)) return 1;
    }
    return 0;
}

static void end_block(budget *f)
{
    const int32_t J = f->s.J, B = f->posterior.B;
    take_levels(f);
    take_references(f);
    transform_references(f, f->R_at, f->posterior.N, 0);
    transform_references(f, f->smooth_R, f->s.L, 1);
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

/* Return whether a sample is a click. A sound that sets in after silence is one, too, until its
 * peak has grown. */
static int is_click(const budget *f, real x, real *peak)
{
    const real size = x < 0 ? -x : x, most = GROWTH * *peak;
    const int click = most > 0 && size > most;
    *peak = larger(click ? most : size, faded(*peak, *f->s.setting[WINDOW], 0));
    return click;
}

/* Cut clicks from the newest references: nothing is learned while cut samples are in the delay
 * lines. */
static void cut_clicks(budget *f)
{
    for (int32_t i = 0; i < f->s.I; i++) {
        real *x = newest(&f->s.x, i);
        if (!within(*x, anc_loudest_learnt) || !is_click(f, *x, f->peak + i)) continue;
        *x = *x < 0 ? -f->peak[i] : f->peak[i];
        f->posterior.heard[HEARD] = -1 - f->posterior.heard[FILLED];
    }
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
    complete_sample(p, error);
    /* Nothing is learned from a block with a click in an error, if anything is known. */
    for (int32_t k = 0; error && k < s->K; k++)
        p->heard[MISSING] |= is_click(f, error[k], f->peak + s->I + k) && *p->fits;
    if (p->heard[FILLED] == p->B) end_block(f);
    return ANC_DONE;
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
