#include "signals.h"

/* ALIGN: bytes, a cache line. SLACK: samples by which a delay line moves before it is copied back.
 */
enum { ALIGN = 64, SLACK = 64 };

/* Within these limits, no square overflows, and no weight or control signal can within 10^40
 * samples (10^5 in float). A step whose factor of the reference is at most CALM needs no look at
 * its length: CALM times the loudest reference is within the longest step. */
#ifdef ANC_FLOAT
const anc_real anc_loudest = 1e12f;
const anc_real anc_loudest_reference = 1e6f;
const anc_real anc_loudest_learnt = 1e6f;
const anc_real anc_longest_step = 1e6f;
static const real CALM = 1;
#else
const anc_real anc_loudest = 1e100;
const anc_real anc_loudest_reference = 1e25;
const anc_real anc_loudest_learnt = 1e20;
const anc_real anc_longest_step = 1e50;
static const real CALM = 1e20;
#endif

/* Layout. */

/* Give the next field its place in the block, and return it; NULL while the block is only measured.
 */
static void *field(anc_layout *at, const char *name, anc_role role, anc_type type,
                   const int32_t shape[4])
{
    const size_t offset = at->size, most = SIZE_MAX / 4;
    size_t bytes = type == ANC_IS_REAL ? sizeof(real) : sizeof(int32_t);
    for (int i = 0; i < 4; i++) {
        const size_t n = (size_t)shape[i];
        bytes = n && bytes > most / n ? most : bytes * n;
    }
    const int too_large = offset > most || bytes >= most;
    at->size = too_large ? SIZE_MAX : offset + (bytes + ALIGN - 1) / ALIGN * ALIGN;
    if (at->visit) at->visit(at->to, name, role, type, offset, shape);
    return at->memory ? at->memory + offset : NULL;
}

real *reals(anc_layout *at, const char *name, anc_role role, int32_t n0, int32_t n1, int32_t n2,
            int32_t n3)
{
    const int32_t shape[4] = {n0, n1, n2, n3};
    return field(at, name, role, ANC_IS_REAL, shape);
}

int32_t *int32s(anc_layout *at, const char *name, anc_role role, int32_t n)
{
    const int32_t shape[4] = {1, 1, 1, n};
    return field(at, name, role, ANC_IS_INT32, shape);
}

void *structs(anc_layout *at, const char *name, anc_role role, int32_t n0, int32_t n1, int32_t n2,
              size_t bytes)
{
    return reals(at, name, role, n0, n1, n2, (int32_t)(bytes / sizeof(real)));
}

static lines layout_lines(anc_layout *at, const char *name, const char *name_at, int32_t n0,
                          int32_t n1, int32_t n2, int32_t taps)
{
    const int32_t length = 2 * taps + SLACK;
    real *room = reals(at, name, ANC_STATE, n0, n1, n2, length);
    return (lines){room, int32s(at, name_at, ANC_STATE, 1), n0 * n1 * n2, taps, length};
}

int32_t numbers_of(const anc_setting *setting, const anc_plan *p)
{
    if (setting->each == ANC_EACH_LOUDSPEAKER) return p->loudspeakers;
    return setting->each == ANC_EACH_MICROPHONE ? p->microphones : 1;
}

static int32_t longest(const int32_t *lengths, int32_t n)
{
    int32_t most = 0;
    for (int32_t i = 0; lengths && i < n; i++)
        if (lengths[i] > most) most = lengths[i];
    return most;
}

void layout_signals(signals *s, const anc_plan *p, const anc_setting *settings, int filtered,
                    anc_layout *at)
{
    const int32_t S = p->scenarios, K = p->microphones, J = p->loudspeakers, I = p->references;
    const int32_t L = p->taps, M = p->path_taps, G = p->guard_taps;
    const int32_t limited = p->limiter_windows ? J : 0, heard = filtered ? K : 0;
    const int32_t kept = L < ANC_GUARD_TAPS ? ANC_GUARD_TAPS : L; /* of x', for a later guard */
    *s = (signals){.S = S, .K = K, .J = J, .I = I, .L = L, .M = M, .G = G};
    s->limited = limited > 0;
    s->modelled = p->modelled ? K : 0;
    s->power_length = longest(p->power_windows, S * J);
    s->limiter_length = longest(p->limiter_windows, S * J);

    s->path = reals(at, "secondary_path", ANC_SETTING, 1, K, J, M);
    s->guard = reals(at, "guard", ANC_SETTING, 1, 1, 1, G);
    s->loudest = reals(at, "loudest", ANC_SETTING, 1, 1, 1, 1);
    for (int i = 0; settings[i].name; i++) {
        const int32_t n = numbers_of(settings + i, p);
        s->setting[i] = reals(at, settings[i].name, ANC_SETTING, 1, 1, 1, n);
    }
    s->amplifier = structs(at, "amplifier", ANC_SETTING, 1, S, J, sizeof *s->amplifier);

    const int32_t taps = kept + M + ANC_GUARD_TAPS - 2;
    s->x = layout_lines(at, "reference", "reference_at", 1, 1, I, taps);
    s->filtered =
        layout_lines(at, "filtered_reference", "filtered_reference_at", heard, J, I, kept);
    s->guarded = layout_lines(at, "guarded_reference", "guarded_reference_at", G ? K : 0, J, I, L);
    s->y = layout_lines(at, "output", "output_at", 1, S, J, M);
    s->internal = reals(at, "internal_reference", ANC_STATE, 1, 1, 1, s->modelled);
    s->weights = reals(at, "weights", ANC_STATE, S, J, I, L);
    s->control = reals(at, "control_signal", ANC_STATE, 1, 1, S, J);

    s->constraint = structs(at, "constraint", ANC_STATE, 1, S, J, sizeof *s->constraint);
    s->powers = structs(at, "powers", ANC_STATE, S, J, ANC_POWERS, sizeof *s->powers);
    s->power_windows = int32s(at, "power_windows", ANC_SETTING, S * J);
    s->power_window = reals(at, "power_window", ANC_STATE, S, J, ANC_POWERS, s->power_length);
    s->limiter = structs(at, "limiter", ANC_STATE, 1, S, limited, sizeof *s->limiter);
    s->laps = reals(at, "laps", ANC_STATE, S, limited, 3, s->limiter_length + 1);

    s->previewed = structs(at, "previewed", ANC_SCRATCH, 1, S, J, sizeof *s->previewed);
    s->estimate = reals(at, "disturbance", ANC_SCRATCH, 1, 1, S, K);
    s->heard = reals(at, "heard", ANC_SCRATCH, 1, 1, S, K);
    s->modelling = reals(at, "modelling", ANC_SCRATCH, 1, 1, 1, s->modelled);
    s->step = structs(at, "step", ANC_SCRATCH, 1, S, J, sizeof *s->step);
}

/* Return `start` + sum |a|. */
static real add_sizes(real start, const real *a, int32_t n)
{
    for (int32_t i = 0; i < n; i++) start += (real)fabs(a[i]);
    return start;
}

/* Set the loudest reference, so that nothing that is filtered from it overflows. What an internal
 * model takes must be soft enough to be learned from, because it is not refused later. */
static void set_loudest(signals *s)
{
    real reach = 1;
    for (int32_t kj = 0; kj < s->K * s->J; kj++)
        reach = larger(add_sizes(0, s->path + times(kj, s->M), s->M), reach);
    const real guard = add_sizes(1, s->guard, s->G);
    *s->loudest = s->filtered.rows ? anc_loudest_reference / reach / guard : anc_loudest;
    if (s->modelled) *s->loudest = smaller(anc_loudest_learnt, *s->loudest);
}

void start_signals(signals *s, const anc_plan *p, const anc_setting *settings)
{
    const anc_constraint none = {
        .rated_power = 1,
        .rate = 1,
        .factor = 1,
        .gain = (real)NAN,
        .supplied_factor = 1,
        .supplied_power = (real)NAN,
        .supplied_gain = (real)NAN,
    };
    const real *from = p->settings;
    copy(s->path, p->path, times(s->K * s->J, s->M));
    for (int32_t g = 0; g < s->G; g++) s->guard[g] = p->guard[g];
    for (int i = 0; settings[i].name; i++)
        for (int32_t n = 0; n < numbers_of(settings + i, p); n++) s->setting[i][n] = *from++;
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        s->power_windows[sj] = p->power_windows ? p->power_windows[sj] : 0;
        s->amplifier[sj] = (anc_amplifier){ANC_LINEAR, 1, 1};
        s->constraint[sj] = none;
    }
    for (int32_t sj = 0; s->limited && sj < s->S * s->J; sj++) {
        const real size = (real)p->limiter_windows[sj]; /* silent until the host sets the numbers */
        s->limiter[sj] = (anc_limiter){.size = size, .spans = 1, .horizon = {size}};
    }
    set_loudest(s);
}

/* A sample. */

/* Make room for one more sample in every row. */
static void advance(lines *l)
{
    if (--*l->at >= 0) return;
    *l->at = l->length - l->taps;
    for (int32_t row = 0; row < l->rows; row++)
        copy(newest(l, row) + 1, l->room + times(row, l->length), (size_t)(l->taps - 1));
}

real reference_of(const signals *s, const real *reference, int32_t i)
{
    const int32_t given = s->I - s->modelled;
    return i < given ? reference[i] : s->internal[i - given];
}

int take_reference(signals *s, const real *reference)
{
    for (int32_t i = 0; i < s->I; i++)
        if (!within(reference_of(s, reference, i), *s->loudest)) return ANC_LOUD_REFERENCE;
    advance(&s->x);
    advance(&s->filtered);
    if (s->G) advance(&s->guarded);
    for (int32_t i = 0; i < s->I; i++) *newest(&s->x, i) = reference_of(s, reference, i);
    for (int32_t k = 0; k < s->modelled; k++) s->internal[k] = 0;
    for (int32_t row = 0; row < s->filtered.rows; row++) {
        const real *x = newest(&s->x, row % s->I);
        real *filtered = newest(&s->filtered, row);
        *filtered = dot(s->path + times(row / s->I, s->M), x, s->M);         /* x' = s^ * x */
        if (s->G) *newest(&s->guarded, row) = dot(s->guard, filtered, s->G); /* x'' = W * x' */
    }
    return ANC_DONE;
}

real filter_output(const signals *s, int32_t sj)
{
    const real *w = weights_of(s, sj);
    real y = 0;
    for (int32_t i = 0; i < s->I; i++) y += dot(w + times(i, s->L), newest(&s->x, i), s->L);
    return y;
}

void emit(signals *s, int32_t sj, real y)
{
    if (sj == 0) advance(&s->y);
    if (s->limited) {
        real *laps = s->laps + times(3 * sj, s->limiter_length + 1);
        y = anc_limit(s->limiter + sj, laps, y);
    }
    s->control[sj] = y;
    *newest(&s->y, sj) = anc_amplify(s->amplifier + sj, y);
}

void emit_all(signals *s, real *control)
{
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        emit(s, sj, filter_output(s, sj));
        control[sj] = s->control[sj];
    }
}

int filtered_signal(anc_view *view, const real *reference, real *control)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    if (!refused) emit_all(s, control);
    return refused;
}

real heard_output(const signals *s, const lines *rows, int32_t scenario, int32_t k)
{
    const real *w = weights_of(s, scenario * s->J);
    const int32_t n = s->J * s->I;
    real sum = 0;
    for (int32_t ji = 0; ji < n; ji++)
        sum += dot(w + times(ji, s->L), newest(rows, k * n + ji), s->L);
    return sum;
}

real energy_of(const signals *s, const lines *rows, int32_t first, int32_t count)
{
    real sum = 0;
    for (int32_t row = first; row < first + count; row++)
        sum += dot(newest(rows, row), newest(rows, row), s->L);
    return sum;
}

real filtered_energy(const signals *s)
{
    return energy_of(s, &s->filtered, 0, s->filtered.rows) +
           energy_of(s, &s->guarded, 0, s->guarded.rows);
}

/* Set d^_k = e_k + sum_j s^_kj * y_j of a microphone of a scenario. */
static int estimate_at(const signals *s, const real *error, int32_t scenario, int32_t k,
                       real *estimated)
{
    real d = error[scenario * s->K + k];
    if (!within(d, anc_loudest)) return ANC_LOUD_ERROR;
    for (int32_t j = 0; j < s->J; j++)
        d += dot(s->path + times(k * s->J + j, s->M), newest(&s->y, scenario * s->J + j), s->M);
    *estimated = d;
    return within(d, s->modelled ? *s->loudest : anc_loudest) ? ANC_DONE : ANC_LOUD_ESTIMATE;
}

static void keep_modelled(signals *s)
{
    if (s->modelled) copy(s->internal, s->modelling, (size_t)s->modelled);
}

int anc_take_error(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    for (int32_t k = 0; k < s->modelled; k++) {
        const int refused = estimate_at(s, error, 0, k, s->modelling + k);
        if (refused) return refused;
    }
    keep_modelled(s);
    return ANC_DONE;
}

/* The window of the powers of loudspeaker sj. */
static real *window_of(const signals *s, int32_t sj)
{
    return s->power_window + times(ANC_POWERS * sj, s->power_length);
}

/* Preview the powers and the factor of loudspeaker sj. Squares of d^ are summed over microphones,
 * of x over references, of x'_j over both. */
static void preview(signals *s, int32_t sj)
{
    const real *d = s->estimate + sj / s->J * s->K;
    real d2 = 0, f2 = 0, x2 = 0;
    for (int32_t k = 0; k < s->K; k++) {
        d2 += d[k] * d[k];
        for (int32_t i = 0; i < s->I; i++) {
            const real f = *newest(&s->filtered, (k * s->J + sj % s->J) * s->I + i);
            f2 += f * f;
        }
    }
    for (int32_t i = 0; i < s->I; i++) x2 += *newest(&s->x, i) * *newest(&s->x, i);
    anc_previewed *next = s->previewed + sj;
    next->square[ANC_DISTURBANCE] = d2;
    next->square[ANC_FILTERED] = f2;
    next->square[ANC_REFERENCE] = x2;
    anc_preview(s->constraint + sj, s->powers + ANC_POWERS * sj, window_of(s, sj),
                s->power_windows[sj], next);
}

int estimate(signals *s, const real *error)
{
    for (int32_t sk = 0; sk < s->S * s->K; sk++) {
        const int refused = estimate_at(s, error, sk / s->K, sk % s->K, s->estimate + sk);
        if (refused) return refused;
    }
    if (s->modelled) copy(s->modelling, s->estimate, (size_t)s->modelled);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) preview(s, sj);
    return ANC_DONE;
}

real least_factor(const signals *s, int32_t scenario)
{
    real heard = 2, unheard = 2; /* a loudspeaker of zero gain counts only if all have zero gain */
    for (int32_t j = 0; j < s->J; j++) {
        const anc_previewed *p = s->previewed + scenario * s->J + j;
        real *least = p->gain == 0 ? &unheard : &heard;
        *least = smaller(p->factor, *least);
    }
    return heard < 2 ? heard : unheard;
}

void commit(signals *s)
{
    keep_modelled(s);
    for (int32_t sj = 0; sj < s->S * s->J; sj++)
        anc_commit(s->constraint + sj, s->powers + ANC_POWERS * sj, window_of(s, sj),
                   s->power_windows[sj], s->previewed + sj);
}

/* Steps. */

/* Return whether all steps are so small that their lengths need no look. */
static int is_calm(const signals *s, const real *error)
{
    for (int32_t sk = 0; sk < s->S * s->K; sk++)
        for (int32_t j = 0; j < s->J; j++) {
            const lms_step *step = s->step + sk / s->K * s->J + j;
            const int calm = within(step->mu * error[sk], CALM) &&
                             within(step->mu * s->heard[sk], CALM) && within(step->penalty, CALM);
            if (!calm) return 0;
        }
    return 1;
}

/* Bound large steps, which a bad sample causes: none corrects more than the whole error, or takes
 * more than the whole control signal away. So weights come back, however large they have become.
 * Return whether all steps are short enough. */
static int bound_steps(signals *s, const real *error)
{
    const real energy = filtered_energy(s);
    const real x2 = energy_of(s, &s->x, 0, s->I), size = root(energy);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        lms_step *step = s->step + sj;
        if (step->mu * energy > 1) step->mu = 1 / energy;
        if (x2 > 0) {
            const real most = (real)fabs(s->control[sj]) / x2;
            step->penalty = larger(-most, smaller(most, step->penalty));
        }
        if (!within(step->penalty * root(x2), anc_longest_step)) return 0;
        for (int32_t k = 0; k < s->K; k++) {
            const int32_t sk = sj / s->J * s->K + k;
            if (!within(step->mu * error[sk] * size, anc_longest_step)) return 0;
            if (!within(step->mu * s->heard[sk] * size, anc_longest_step)) return 0;
        }
    }
    return 1;
}

/* w = keep w + mu sum_k e_k x'_k - penalty x for the control filter from reference i to loudspeaker
 * sj; before, with a guard, w -= mu (w'x'') x'', a leak where the paths are uncertain. */
static void step_weights(const signals *s, const real *error, int32_t sj, int32_t i)
{
    const int32_t scenario = sj / s->J, ji = sj % s->J * s->I + i, rows = s->J * s->I;
    const lms_step step = s->step[sj];
    const real *restrict x = newest(&s->x, i);
    const real *e = error + scenario * s->K, *heard = s->heard + scenario * s->K;
    real *restrict w = weights_of(s, sj) + times(i, s->L);
    for (int32_t k = 0; s->G && k < s->K; k++)
        add_scaled(w, -step.mu * heard[k], newest(&s->guarded, k * rows + ji), s->L);
    if (step.keep != 1 || step.penalty != 0)
        for (int32_t l = 0; l < s->L; l++) w[l] = flushed(step.keep * w[l] - step.penalty * x[l]);
    for (int32_t k = 0; k < s->K; k++)
        add_scaled(w, step.mu * e[k], newest(&s->filtered, k * rows + ji), s->L);
}

int descend(signals *s, const real *error)
{
    for (int32_t sk = 0; sk < s->S * s->K; sk++)
        s->heard[sk] = s->G ? heard_output(s, &s->guarded, sk / s->K, sk % s->K) : 0;
    if (!is_calm(s, error) && !bound_steps(s, error)) return ANC_LOUD_STEP;
    commit(s);
    for (int32_t sj = 0; sj < s->S * s->J; sj++)
        for (int32_t i = 0; i < s->I; i++) step_weights(s, error, sj, i);
    return ANC_DONE;
}

/* Before control is on, and after a change. */

/* Follow the powers only. */
static int follow(signals *s, const real *error)
{
    const int refused = error ? estimate(s, error) : ANC_DONE;
    if (error && !refused) commit(s);
    return refused;
}

static int listen_to(const anc_algorithm *a, anc_view *view, const real *x, const real *e,
                     int adapting)
{
    signals *s = (signals *)view;
    const real *error = adapting ? e : NULL;
    int refused = take_reference(s, x);
    if (refused) return refused;
    for (int32_t sj = 0; sj < s->S * s->J; sj++) emit(s, sj, 0);
    refused = a->listen ? a->listen(view, error) : follow(s, error);
    return refused || adapting ? refused : anc_take_error(view, e);
}

int64_t anc_listen(const anc_algorithm *a, anc_view *view, const real *x, const real *e,
                   const uint8_t *adapt, int64_t n, int32_t *answer)
{
    const signals *s = (const signals *)view;
    for (int64_t t = 0; t < n; t++) {
        const real *reference = x + t * (s->I - s->modelled), *error = e + t * s->S * s->K;
        *answer = listen_to(a, view, reference, error, adapt[t]);
        if (*answer) return t;
    }
    return n;
}

void anc_refilter(anc_view *view)
{
    signals *s = (signals *)view;
    for (int32_t row = 0; row < s->filtered.rows; row++) {
        const real *x = newest(&s->x, row % s->I), *path = s->path + times(row / s->I, s->M);
        real *filtered = newest(&s->filtered, row);
        for (int32_t n = 0; n < s->filtered.taps; n++) filtered[n] = dot(path, x + n, s->M);
        /* The guard also needs x' from before its delay line, which is computed here again. */
        for (int32_t n = 0; s->G && n < s->L; n++) {
            real sum = 0;
            for (int32_t g = 0; g < s->G; g++) sum += s->guard[g] * dot(path, x + n + g, s->M);
            newest(&s->guarded, row)[n] = sum;
        }
    }
    set_loudest(s);
}

/* The signals alone, for an estimator of the host, which takes d^ and sets the weights. */

static const anc_setting none[] = {{0}};

static int update_estimate(anc_view *view, const real *error)
{
    if (!error) return ANC_DONE;
    const int refused = estimate((signals *)view, error);
    if (!refused) keep_modelled((signals *)view);
    return refused;
}

const anc_algorithm anc_signals_alone = {.name = "signals alone",
                                         .settings = none,
                                         .control_signal = filtered_signal,
                                         .update = update_estimate};
