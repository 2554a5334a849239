/* FxLMS (Morgan 1980), with several channels the multiple-error LMS (Elliott 1987), and its relatives. Each sets the step of
 * every loudspeaker, w_ji(n+1) = keep_j w_ji(n) + mu_j sum_k e_k(n) x'_kji(n) - penalty_j x_i(n), and descends. */
#include "signals.h"

enum { STEP_SIZE }; /* the first setting of all */

static void set_step(signals *s, int32_t j, real keep, real mu, real penalty)
{
    real *step = s->step + STEPS * j;
    step[KEEP] = keep, step[MU] = mu, step[PENALTY] = penalty;
}

static int control_signal(anc_view *view, const real *reference, real *control)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    for (int32_t j = 0; !refused && j < s->J; j++) emit(s, j, filter_output(s, j)), control[j] = s->control[j];
    return refused;
}

static void layout(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at) { layout_signals((signals *)view, plan, settings, at); }
static void start(anc_view *view, const anc_plan *plan, const anc_setting *settings) { start_signals((signals *)view, plan, settings); }

/* FxLMS: w(n+1) = w(n) + mu e(n) x'(n). */

static const anc_setting fxlms[] = {{"step_size", 0, 0, 0}, {0}};

static int update_fxlms(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    for (int32_t j = 0; j < s->J; j++) set_step(s, j, 1, *s->setting[STEP_SIZE], 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_fxlms = {"FxLMS", fxlms, layout, start, control_signal, update_fxlms};

/* FxNLMS: w(n+1) = w(n) + mu e(n) x'(n) / (epsilon + x'(n)'x'(n)), with the energy of all filtered references. */

enum { REGULARIZATION = STEP_SIZE + 1 };
static const anc_setting fxnlms[] = {{"step_size", 0, 0, 0}, {"regularization", 0, 0, 0}, {0}};

static real energy(const signals *s, const lines *rows)
{
    real sum = 0;
    for (int32_t row = 0; row < rows->rows; row++) sum += dot(newest(rows, row), newest(rows, row), s->L);
    return sum;
}

static int update_fxnlms(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    const real all = *s->setting[REGULARIZATION] + energy(s, &s->filtered) + energy(s, &s->guarded);
    for (int32_t j = 0; j < s->J; j++) set_step(s, j, 1, *s->setting[STEP_SIZE] / all, 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_fxnlms = {"FxNLMS", fxnlms, layout, start, control_signal, update_fxnlms};

/* Leaky FxLMS: w(n+1) = (1 - mu gamma) w(n) + mu e(n) x'(n). */

enum { LEAK = STEP_SIZE + 1 };
static const anc_setting leaky[] = {{"step_size", 0, 0, 0}, {"leak", 0, 0, 1}, {0}};

static int update_leaky(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    const real mu = *s->setting[STEP_SIZE];
    for (int32_t j = 0; j < s->J; j++) set_step(s, j, 1 - mu * s->setting[LEAK][j], mu, 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_leaky = {"leaky FxLMS", leaky, layout, start, control_signal, update_leaky};

/* Optimal leaky FxLMS: the same with gamma(n) = E[x^2] G_s (1 / alpha - 1). */

/* Return G_s (1 / alpha - 1): 0 if the rated power is enough, and until a signal has passed the estimated path. */
static real penalty_of_constraint(const anc_previewed *p)
{
    return p->factor < 1 && p->gain > 0 ? p->gain * (1 / p->factor - 1) : 0;
}

static int update_optimal_leaky(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    const real mu = *s->setting[STEP_SIZE];
    for (int32_t j = 0; j < s->J; j++)
        set_step(s, j, 1 - mu * (penalty_of_constraint(s->previewed + j) * s->previewed[j].mean[ANC_REFERENCE]), mu, 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_optimal_leaky = {"optimal leaky FxLMS", fxlms, layout, start, control_signal, update_optimal_leaky};

/* MOV-FxLMS: w(n+1) = w(n) + mu [e(n) x'(n) - gamma y(n) x(n)], with gamma = G_s (1 / alpha - 1), or a fixed one.
 * Modified, it adapts to d^ - w'x' in place of the error. */

enum { MODIFIED = STEP_SIZE + 1, PENALTY_FACTOR };
static const anc_setting mov[] = {{"step_size", 0, 0, 0}, {"modified", 0, 1, 0}, {0}};
static const anc_setting mov_fixed[] = {{"step_size", 0, 0, 0}, {"modified", 0, 1, 0}, {"penalty_factor", 0, 0, 1}, {0}};

static int descend_mov(signals *s, const real *error, const real *fixed)
{
    const int refused = estimate(s, error);
    const real mu = *s->setting[STEP_SIZE];
    if (refused) return refused;
    for (int32_t j = 0; j < s->J; j++) {
        const real gamma = fixed ? fixed[j] : penalty_of_constraint(s->previewed + j);
        set_step(s, j, 1, mu, mu * gamma * s->control[j]);
    }
    if (*s->setting[MODIFIED] == 0) return descend(s, error);
    for (int32_t k = 0; k < s->K; k++) s->estimate[k] -= heard_output(s, &s->filtered, k);
    return descend(s, s->estimate);
}

static int update_mov(anc_view *view, const real *error) { return error ? descend_mov((signals *)view, error, NULL) : ANC_DONE; }

static int update_mov_fixed(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    return error ? descend_mov(s, error, s->setting[PENALTY_FACTOR]) : ANC_DONE;
}

const anc_algorithm anc_mov = {"MOV-FxLMS", mov, layout, start, control_signal, update_mov};
const anc_algorithm anc_mov_fixed = {"MOV-FxLMS fixed", mov_fixed, layout, start, control_signal, update_mov_fixed};

/* Two-gradient FxLMS (Shi et al. 2019): FxLMS while |y(n)| <= A, else w(n+1) = w(n) - mu_y y(n) x(n). */

enum { AMPLITUDE_LIMIT = STEP_SIZE + 1, OUTPUT_STEP_SIZE };
static const anc_setting two_gradient[] = {{"step_size", 0, 0, 0}, {"amplitude_limit", 0, 0, 1}, {"output_step_size", 0, 0, 0}, {0}};

static int update_two_gradient(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    for (int32_t j = 0; j < s->J; j++) {
        const real y = s->control[j];
        if (within(y, s->setting[AMPLITUDE_LIMIT][j])) set_step(s, j, 1, *s->setting[STEP_SIZE], 0);
        else set_step(s, j, 1, 0, *s->setting[OUTPUT_STEP_SIZE] * y);
    }
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_two_gradient = {"two-gradient FxLMS", two_gradient, layout, start, control_signal, update_two_gradient};

/* Clipping FxLMS (Qiu and Hansen 2001): y(n) is clipped to A; re-scaling FxLMS: and w scaled by A / |y(n)|. Then FxLMS. */

static const anc_setting limited[] = {{"step_size", 0, 0, 0}, {"amplitude_limit", 0, 0, 1}, {0}};

static int limited_signal(anc_view *view, const real *reference, real *control, int rescaling)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    for (int32_t j = 0; !refused && j < s->J; j++) {
        const real limit = s->setting[AMPLITUDE_LIMIT][j];
        real y = filter_output(s, j);
        if (!within(y, limit)) {
            const real clipped = y > 0 ? limit : -limit, ratio = clipped / y;
            for (int32_t i = 0; rescaling && i < s->I * s->L; i++) weights_of(s, j)[i] *= ratio;
            y = clipped;
        }
        emit(s, j, y), control[j] = s->control[j];
    }
    return refused;
}

static int control_signal_clipping(anc_view *view, const real *reference, real *control) { return limited_signal(view, reference, control, 0); }
static int control_signal_rescaling(anc_view *view, const real *reference, real *control) { return limited_signal(view, reference, control, 1); }

const anc_algorithm anc_clipping = {"clipping FxLMS", limited, layout, start, control_signal_clipping, update_fxlms};
const anc_algorithm anc_rescaling = {"re-scaling FxLMS", limited, layout, start, control_signal_rescaling, update_fxlms};
