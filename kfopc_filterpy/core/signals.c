#include "signals.h"
#include <string.h>

enum { ALIGN = 64, SLACK = 64 };

/* With these, no square overflows, and no weight or control signal can within 10^40 samples (10^5 in float). CALM: up to it,
 * a factor of the reference in a step is not looked at, for CALM times the loudest reference is no long step. */
#ifdef ANC_FLOAT
const anc_real anc_loudest = 1e12f, anc_loudest_reference = 1e6f, anc_loudest_learnt = 1e6f, anc_longest_step = 1e6f;
static const real CALM = 1;
#else
const anc_real anc_loudest = 1e100, anc_loudest_reference = 1e25, anc_loudest_learnt = 1e20, anc_longest_step = 1e50;
static const real CALM = 1e20;
#endif

/* Layout. */

/* Give the next field its place in the block, and return it; NULL while the block is only measured. */
static void *field(anc_layout *at, const char *name, anc_role role, anc_type type, const int32_t shape[4])
{
    const size_t offset = at->size, most = SIZE_MAX / 4;
    size_t bytes = type == ANC_IS_REAL ? sizeof(real) : sizeof(int32_t);
    for (int i = 0; i < 4; i++) bytes = shape[i] && bytes > most / (size_t)shape[i] ? most : bytes * (size_t)shape[i];
    at->size = offset > most || bytes >= most ? SIZE_MAX : offset + (bytes + ALIGN - 1) / ALIGN * ALIGN;
    if (at->visit) at->visit(at->to, name, role, type, offset, shape);
    return at->memory ? at->memory + offset : NULL;
}

real *reals(anc_layout *at, const char *name, anc_role role, int32_t n0, int32_t n1, int32_t n2, int32_t n3)
{
    const int32_t shape[4] = {n0, n1, n2, n3};
    return field(at, name, role, ANC_IS_REAL, shape);
}

int32_t *int32s(anc_layout *at, const char *name, anc_role role, int32_t n)
{
    const int32_t shape[4] = {1, 1, 1, n};
    return field(at, name, role, ANC_IS_INT32, shape);
}

static lines layout_lines(anc_layout *at, const char *name, const char *name_at, int32_t n0, int32_t n1, int32_t n2, int32_t taps)
{
    const int32_t length = 2 * taps + SLACK;
    real *room = reals(at, name, ANC_STATE, n0, n1, n2, length);
    return (lines){room, int32s(at, name_at, ANC_STATE, 1), n0 * n1 * n2, taps, length};
}

int32_t numbers_of(const anc_setting *setting, const anc_plan *p)
{
    return setting->each == ANC_EACH_LOUDSPEAKER ? p->loudspeakers : setting->each == ANC_EACH_MICROPHONE ? p->microphones : 1;
}

static int32_t longest(const int32_t *lengths, int32_t n)
{
    int32_t most = 0;
    for (int32_t i = 0; lengths && i < n; i++) most = lengths[i] > most ? lengths[i] : most;
    return most;
}

static void layout_all(signals *s, const anc_plan *p, const anc_setting *settings, anc_layout *at, int with_filtered)
{
    const int32_t S = p->scenarios, K = p->microphones, J = p->loudspeakers, I = p->references;
    const int32_t L = p->taps, M = p->path_taps, G = p->guard_taps;
    const int32_t filtered = L < ANC_GUARD_TAPS ? ANC_GUARD_TAPS : L; /* for a later guard */
    s->S = S, s->K = K, s->J = J, s->I = I, s->L = L, s->M = M, s->G = G;
    s->limited = p->limited, s->modelled = p->modelled ? K : 0;
    s->power_length = longest(p->power_windows, S * J), s->limiter_length = longest(p->limiter_windows, S * J);
    s->path = reals(at, "secondary_path", ANC_SETTING, 1, K, J, M);
    s->guard = reals(at, "guard", ANC_SETTING, 1, 1, 1, G);
    s->loudest = reals(at, "loudest", ANC_SETTING, 1, 1, 1, 1);
    for (int i = 0; settings[i].name; i++) s->setting[i] = reals(at, settings[i].name, ANC_SETTING, 1, 1, 1, numbers_of(settings + i, p));
    s->amplifier = (anc_amplifier *)reals(at, "amplifier", ANC_SETTING, 1, S, J, COLUMNS(anc_amplifier));
    s->x = layout_lines(at, "reference", "reference_at", 1, 1, I, filtered + M + ANC_GUARD_TAPS - 2);
    s->filtered = layout_lines(at, "filtered_reference", "filtered_reference_at", with_filtered ? K : 0, J, I, filtered);
    s->guarded = layout_lines(at, "guarded_reference", "guarded_reference_at", G ? K : 0, J, I, L);
    s->y = layout_lines(at, "output", "output_at", 1, S, J, M);
    s->internal = reals(at, "internal_reference", ANC_STATE, 1, 1, 1, s->modelled);
    s->weights = reals(at, "weights", ANC_STATE, S, J, I, L);
    s->control = reals(at, "control_signal", ANC_STATE, 1, 1, S, J);
    s->constraint = (anc_constraint *)reals(at, "constraint", ANC_STATE, 1, S, J, COLUMNS(anc_constraint));
    s->powers = (anc_power *)reals(at, "powers", ANC_STATE, S, J, ANC_POWERS, COLUMNS(anc_power));
    s->power_windows = int32s(at, "power_windows", ANC_SETTING, S * J);
    s->power_window = reals(at, "power_window", ANC_STATE, S, J, ANC_POWERS, s->power_length);
    s->limiter = (anc_limiter *)reals(at, "limiter", ANC_STATE, 1, S, p->limited ? J : 0, COLUMNS(anc_limiter));
    s->laps = reals(at, "laps", ANC_STATE, S, p->limited ? J : 0, 3, s->limiter_length + 1);
    s->previewed = (anc_previewed *)reals(at, "previewed", ANC_SCRATCH, 1, S, J, COLUMNS(anc_previewed));
    s->estimate = reals(at, "disturbance", ANC_SCRATCH, 1, 1, S, K);
    s->heard = reals(at, "heard", ANC_SCRATCH, 1, 1, S, K);
    s->modelling = reals(at, "modelling", ANC_SCRATCH, 1, 1, 1, s->modelled);
    s->squares = reals(at, "squares", ANC_SCRATCH, 1, S, J, ANC_POWERS);
    s->step = reals(at, "step", ANC_SCRATCH, 1, S, J, STEPS);
}

void layout_signals(signals *s, const anc_plan *p, const anc_setting *settings, anc_layout *at) { layout_all(s, p, settings, at, 1); }
void layout_unfiltered(signals *s, const anc_plan *p, const anc_setting *settings, anc_layout *at) { layout_all(s, p, settings, at, 0); }

/* Set the loudest reference, so that nothing that is filtered from it overflows. What an internal model takes can be learned
 * from, too: it is not refused later. */
static void set_loudest(signals *s)
{
    real reach = 1, guard = 1;
    for (int32_t kj = 0; kj < s->K * s->J; kj++) {
        real sum = 0;
        for (int32_t m = 0; m < s->M; m++) sum += (real)fabs(s->path[times(kj, s->M) + (size_t)m]);
        if (sum > reach) reach = sum;
    }
    for (int32_t g = 0; g < s->G; g++) guard += (real)fabs(s->guard[g]);
    *s->loudest = s->filtered.rows ? anc_loudest_reference / reach / guard : anc_loudest;
    if (s->modelled && *s->loudest > anc_loudest_learnt) *s->loudest = anc_loudest_learnt;
}

void start_signals(signals *s, const anc_plan *p, const anc_setting *settings)
{
    const real *from = p->settings;
    memcpy(s->path, p->path, sizeof(real) * times(s->K * s->J, s->M));
    if (s->G) memcpy(s->guard, p->guard, sizeof(real) * (size_t)s->G);
    for (int i = 0; settings[i].name; i++)
        for (int32_t n = 0; n < numbers_of(settings + i, p); n++) s->setting[i][n] = *from++;
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        s->power_windows[sj] = p->power_windows ? p->power_windows[sj] : 0;
        s->amplifier[sj] = (anc_amplifier){ANC_LINEAR, 1, 1};
        s->constraint[sj] = (anc_constraint){.rated_power = 1, .rate = 1, .supplied_factor = 1, .supplied_power = (real)NAN,
                                            .supplied_gain = (real)NAN, .factor = 1, .gain = (real)NAN};
        if (s->limited) /* silent, and within its laps, until the host sets its numbers */
            s->limiter[sj] = (anc_limiter){.size = (real)p->limiter_windows[sj], .spans = 1, .horizon = {(real)p->limiter_windows[sj]}};
    }
    set_loudest(s);
}

void layout_plain(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at) { layout_signals((signals *)view, plan, settings, at); }
void start_plain(anc_view *view, const anc_plan *plan, const anc_setting *settings) { start_signals((signals *)view, plan, settings); }

/* A sample. */

/* Make room for one more sample in every row. */
static void advance(lines *l)
{
    if (--*l->at >= 0) return;
    *l->at = l->length - l->taps;
    for (int32_t row = 0; row < l->rows; row++)
        memcpy(newest(l, row) + 1, l->room + times(row, l->length), sizeof(real) * (size_t)(l->taps - 1));
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
    advance(&s->x), advance(&s->filtered);
    if (s->G) advance(&s->guarded);
    for (int32_t i = 0; i < s->I; i++) *newest(&s->x, i) = reference_of(s, reference, i);
    for (int32_t k = 0; k < s->modelled; k++) s->internal[k] = 0;
    for (int32_t kj = 0; s->filtered.rows && kj < s->K * s->J; kj++)
        for (int32_t i = 0; i < s->I; i++) {
            const int32_t row = kj * s->I + i;
            *newest(&s->filtered, row) = dot(s->path + times(kj, s->M), newest(&s->x, i), s->M); /* x' = s^ * x */
            if (s->G) *newest(&s->guarded, row) = dot(s->guard, newest(&s->filtered, row), s->G); /* x'' = W * x' */
        }
    return ANC_DONE;
}

real filter_output(const signals *s, int32_t sj)
{
    real y = 0;
    for (int32_t i = 0; i < s->I; i++) y += dot(weights_of(s, sj) + times(i, s->L), newest(&s->x, i), s->L);
    return y;
}

void emit(signals *s, int32_t sj, real y)
{
    if (sj == 0) advance(&s->y);
    if (s->limited) y = anc_limit(s->limiter + sj, s->laps + times(3 * sj, s->limiter_length + 1), y);
    s->control[sj] = y;
    *newest(&s->y, sj) = anc_amplify(s->amplifier + sj, y);
}

int filtered_signal(anc_view *view, const real *reference, real *control)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    for (int32_t sj = 0; !refused && sj < s->S * s->J; sj++) emit(s, sj, filter_output(s, sj)), control[sj] = s->control[sj];
    return refused;
}

real heard_output(const signals *s, const lines *rows, int32_t scenario, int32_t k)
{
    const real *w = weights_of(s, scenario * s->J);
    real sum = 0;
    for (int32_t ji = 0; ji < s->J * s->I; ji++) sum += dot(w + times(ji, s->L), newest(rows, k * s->J * s->I + ji), s->L);
    return sum;
}

real energy_of(const signals *s, const lines *rows, int32_t first, int32_t count)
{
    real sum = 0;
    for (int32_t row = first; row < first + count; row++) sum += dot(newest(rows, row), newest(rows, row), s->L);
    return sum;
}

/* Set d^_k = e_k + sum_j s^_kj * y_j of a microphone of a scenario. */
static int estimate_at(const signals *s, const real *error, int32_t scenario, int32_t k, real *estimated)
{
    real d = error[scenario * s->K + k];
    if (!within(d, anc_loudest)) return ANC_LOUD_ERROR;
    for (int32_t j = 0; j < s->J; j++) d += dot(s->path + times(k * s->J + j, s->M), newest(&s->y, scenario * s->J + j), s->M);
    *estimated = d;
    return within(d, s->modelled ? *s->loudest : anc_loudest) ? ANC_DONE : ANC_LOUD_ESTIMATE;
}

static void keep_modelled(signals *s)
{
    for (int32_t k = 0; k < s->modelled; k++) s->internal[k] = s->modelling[k];
}

int anc_take_error(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    int refused = ANC_DONE;
    for (int32_t k = 0; !refused && k < s->modelled; k++) refused = estimate_at(s, error, 0, k, s->modelling + k);
    if (!refused) keep_modelled(s);
    return refused;
}

int estimate_disturbance(signals *s, const real *error)
{
    real x2 = 0;
    for (int32_t i = 0; i < s->I; i++) x2 += *newest(&s->x, i) * *newest(&s->x, i);
    for (int32_t scenario = 0; scenario < s->S; scenario++) {
        real *estimates = s->estimate + scenario * s->K, d2 = 0;
        for (int32_t k = 0; k < s->K; k++) {
            const int refused = estimate_at(s, error, scenario, k, estimates + k);
            if (refused) return refused;
            d2 += estimates[k] * estimates[k];
            if (s->modelled) s->modelling[k] = estimates[k];
        }
        /* Squares of d^ are summed over microphones, of x over references, of x'_j over both. */
        for (int32_t j = 0; j < s->J; j++) {
            real *squares = s->squares + ANC_POWERS * (scenario * s->J + j), f2 = 0;
            for (int32_t k = 0; k < s->K; k++)
                for (int32_t i = 0; i < s->I; i++) {
                    const real f = *newest(&s->filtered, (k * s->J + j) * s->I + i);
                    f2 += f * f;
                }
            squares[ANC_DISTURBANCE] = d2, squares[ANC_FILTERED] = f2, squares[ANC_REFERENCE] = x2;
        }
    }
    return ANC_DONE;
}

static real *window_of(const signals *s, int32_t sj) { return s->power_window + times(ANC_POWERS * sj, s->power_length); }

void preview(signals *s)
{
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        const real *squares = s->squares + ANC_POWERS * sj;
        anc_preview(s->constraint + sj, s->powers + ANC_POWERS * sj, window_of(s, sj), s->power_windows[sj], s->previewed + sj,
                    squares[ANC_DISTURBANCE], squares[ANC_FILTERED], squares[ANC_REFERENCE]);
    }
}

int estimate(signals *s, const real *error)
{
    const int refused = estimate_disturbance(s, error);
    if (!refused) preview(s);
    return refused;
}

real least_factor(const signals *s, int32_t scenario)
{
    real heard = 2, unheard = 2; /* a loudspeaker of zero gain is silent: it counts only if all are */
    for (int32_t j = 0; j < s->J; j++) {
        const anc_previewed *p = s->previewed + scenario * s->J + j;
        real *least = p->gain == 0 ? &unheard : &heard;
        if (p->factor < *least) *least = p->factor;
    }
    return heard < 2 ? heard : unheard;
}

void commit(signals *s)
{
    keep_modelled(s);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        const real *squares = s->squares + ANC_POWERS * sj;
        anc_commit(s->constraint + sj, s->powers + ANC_POWERS * sj, window_of(s, sj), s->power_windows[sj], s->previewed + sj,
                   squares[ANC_DISTURBANCE], squares[ANC_FILTERED], squares[ANC_REFERENCE]);
    }
}

void set_step(signals *s, int32_t sj, real keep, real mu, real penalty)
{
    real *step = s->step + STEPS * sj;
    step[KEEP] = keep, step[MU] = mu, step[PENALTY] = penalty;
}

static real bounded(real value, real most) { return value > most ? most : value < -most ? -most : value; }

/* Bound large steps, which a bad sample causes: none corrects more than the whole error, or takes more than the whole control
 * signal away. So the weights go back, however large they have become. Return whether all are short enough. */
static int bound_steps(signals *s, const real *error)
{
    const real energy = energy_of(s, &s->filtered, 0, s->filtered.rows) + energy_of(s, &s->guarded, 0, s->guarded.rows);
    const real x2 = energy_of(s, &s->x, 0, s->I), size = root(energy);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        real *step = s->step + STEPS * sj;
        if (step[MU] * energy > 1) step[MU] = 1 / energy;
        if (x2 > 0) step[PENALTY] = bounded(step[PENALTY], (real)fabs(s->control[sj]) / x2);
        for (int32_t sk = sj / s->J * s->K; sk < (sj / s->J + 1) * s->K; sk++)
            if (!within(step[MU] * error[sk] * size, anc_longest_step) || !within(step[MU] * s->heard[sk] * size, anc_longest_step)) return 0;
        if (!within(step[PENALTY] * root(x2), anc_longest_step)) return 0;
    }
    return 1;
}

int descend(signals *s, const real *error)
{
    int calm = 1;
    for (int32_t scenario = 0; scenario < s->S; scenario++)
        for (int32_t k = 0; k < s->K; k++) {
            const real e = error[scenario * s->K + k], heard = s->G ? heard_output(s, &s->guarded, scenario, k) : 0;
            s->heard[scenario * s->K + k] = heard;
            for (int32_t j = 0; j < s->J; j++) {
                const real *step = s->step + STEPS * (scenario * s->J + j);
                calm &= within(step[MU] * e, CALM) && within(step[MU] * heard, CALM) && within(step[PENALTY], CALM);
            }
        }
    if (!calm && !bound_steps(s, error)) return ANC_LOUD_STEP;
    commit(s);
    for (int32_t scenario = 0; scenario < s->S; scenario++)
        for (int32_t j = 0; j < s->J; j++)
            for (int32_t i = 0; i < s->I; i++) {
                const int32_t ji = j * s->I + i, rows = s->J * s->I;
                const real *step = s->step + STEPS * (scenario * s->J + j), *e = error + scenario * s->K, *heard = s->heard + scenario * s->K;
                real *w = s->weights + times(scenario * rows + ji, s->L);
                for (int32_t k = 0; s->G && k < s->K; k++) /* a leak where the paths are uncertain: w -= mu (w'x'') x'' */
                    add_scaled(w, -step[MU] * heard[k], newest(&s->guarded, k * rows + ji), s->L);
                if (step[KEEP] != 1 || step[PENALTY] != 0) shrink(w, step[KEEP], step[PENALTY], newest(&s->x, i), s->L);
                for (int32_t k = 0; k < s->K; k++) add_scaled(w, step[MU] * e[k], newest(&s->filtered, k * rows + ji), s->L);
            }
    return ANC_DONE;
}

static int follow(signals *s, const real *error)
{
    const int refused = estimate(s, error);
    if (!refused) commit(s);
    return refused;
}

int64_t anc_listen(const anc_algorithm *a, anc_view *view, const real *x, const real *e, const uint8_t *adapt, int64_t n, int32_t *answer)
{
    signals *s = (signals *)view;
    for (int64_t t = 0; t < n; t++) {
        const real *error = adapt[t] ? e + t * s->S * s->K : NULL;
        if ((*answer = take_reference(s, x + t * (s->I - s->modelled)))) return t;
        for (int32_t sj = 0; sj < s->S * s->J; sj++) emit(s, sj, 0);
        if ((*answer = a->listen ? a->listen(view, error) : error ? follow(s, error) : ANC_DONE)) return t;
        if (!error && (*answer = anc_take_error(view, e + t * s->K))) return t;
    }
    return n;
}

void anc_refilter(anc_view *view)
{
    signals *s = (signals *)view;
    for (int32_t kj = 0; s->filtered.rows && kj < s->K * s->J; kj++)
        for (int32_t i = 0; i < s->I; i++) {
            real *filtered = newest(&s->filtered, kj * s->I + i);
            for (int32_t n = 0; n < s->filtered.taps; n++) filtered[n] = dot(s->path + times(kj, s->M), newest(&s->x, i) + n, s->M);
            /* The guard also needs x' from before its delay line, which is computed here again. */
            for (int32_t n = 0; s->G && n < s->L; n++) {
                real sum = 0;
                for (int32_t g = 0; g < s->G; g++) sum += s->guard[g] * dot(s->path + times(kj, s->M), newest(&s->x, i) + n + g, s->M);
                newest(&s->guarded, kj * s->I + i)[n] = sum;
            }
        }
    set_loudest(s);
}

/* The signals alone, for an estimator of the host, which takes d^ and sets the weights. */

static const anc_setting none[] = {{0}};

static int update_estimate(anc_view *view, const real *error)
{
    const int refused = error ? estimate((signals *)view, error) : ANC_DONE;
    if (error && !refused) keep_modelled((signals *)view);
    return refused;
}

const anc_algorithm anc_signals_alone = {"signals alone", none, layout_plain, start_plain, filtered_signal, update_estimate, NULL};
