/* FxLMS (Morgan 1980), with several channels the multiple-error LMS (Elliott 1987), and its relatives. Each sets the step of
 * every loudspeaker, w_ji(n+1) = keep_j w_ji(n) + mu_j sum_k e_k(n) x'_kji(n) - penalty_j x_i(n), and descends. */
#include "signals.h"

enum { STEP_SIZE }; /* the first setting of all */

/* FxLMS: w(n+1) = w(n) + mu e(n) x'(n). */

static const anc_setting fxlms[] = {{"step_size", 0, 0, ANC_ONE}, {0}};

static int update_fxlms(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) set_step(s, sj, 1, *s->setting[STEP_SIZE], 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_fxlms = {"FxLMS", fxlms, layout_plain, start_plain, filtered_signal, update_fxlms, NULL};

/* FxNLMS: w(n+1) = w(n) + mu e(n) x'(n) / (epsilon + x'(n)'x'(n)), with the energy of all filtered references. If epsilon is
 * 0, the energy counts as QUIET of the usual one at least: in a quiet passage, the weights would follow the noise of the
 * microphones. The usual energy follows a louder signal within a filter length, which a bad sample is not, and a softer one
 * within HELD filter lengths. */

enum { REGULARIZATION = STEP_SIZE + 1 };
static const real QUIET = (real)1e-3, RISE = 4, HELD = 1000; /* e^RISE within a filter length */
typedef struct { signals s; real *usual; } normalised;
static const anc_setting fxnlms[] = {{"step_size", 0, 0, ANC_ONE}, {"regularization", 0, 0, ANC_ONE}, {0}};

static void layout_fxnlms(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at)
{
    normalised *own = (normalised *)view;
    layout_signals(&own->s, plan, settings, at);
    own->usual = reals(at, "usual_energy", ANC_STATE, 1, 1, 1, 1);
}

static int update_fxnlms(anc_view *view, const real *error)
{
    normalised *own = (normalised *)view;
    signals *s = &own->s;
    int refused = error ? estimate(s, error) : ANC_DONE;
    if (!error || refused) return refused;
    const real energy = energy_of(s, &s->filtered, 0, s->filtered.rows) + energy_of(s, &s->guarded, 0, s->guarded.rows);
    const real epsilon = *s->setting[REGULARIZATION], usual = *own->usual > 0 ? *own->usual : energy, L = (real)s->L;
    const real all = epsilon > 0 ? epsilon + energy : larger(energy, QUIET * usual);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) set_step(s, sj, 1, all > 0 ? *s->setting[STEP_SIZE] / all : 0, 0);
    refused = descend(s, error);
    if (!refused) *own->usual = held_value(usual, energy, 1 - 1 / (HELD * L), 1 + RISE / L);
    return refused;
}

const anc_algorithm anc_fxnlms = {"FxNLMS", fxnlms, layout_fxnlms, start_plain, filtered_signal, update_fxnlms, NULL};

/* Leaky FxLMS: w(n+1) = (1 - mu gamma) w(n) + mu e(n) x'(n). */

enum { LEAK = STEP_SIZE + 1 };
static const anc_setting leaky[] = {{"step_size", 0, 0, ANC_ONE}, {"leak", 0, 0, ANC_EACH_LOUDSPEAKER}, {0}};

static int update_leaky(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    const real mu = *s->setting[STEP_SIZE];
    for (int32_t sj = 0; sj < s->S * s->J; sj++) set_step(s, sj, 1 - mu * s->setting[LEAK][sj % s->J], mu, 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_leaky = {"leaky FxLMS", leaky, layout_plain, start_plain, filtered_signal, update_leaky, NULL};

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
    for (int32_t sj = 0; sj < s->S * s->J; sj++)
        set_step(s, sj, larger(1 - mu * (penalty_of_constraint(s->previewed + sj) * s->previewed[sj].mean[ANC_REFERENCE]), 0), mu, 0);
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_optimal_leaky = {"optimal leaky FxLMS", fxlms, layout_plain, start_plain, filtered_signal, update_optimal_leaky, NULL};

/* MOV-FxLMS: w(n+1) = w(n) + mu [e(n) x'(n) - gamma y(n) x(n)], with gamma = G_s (1 / alpha - 1), or a fixed one.
 * Modified, it adapts to d^ - w'x' in place of the error. */

enum { MODIFIED = STEP_SIZE + 1, PENALTY_FACTOR };
static const anc_setting mov[] = {{"step_size", 0, 0, ANC_ONE}, {"modified", 0, 1, ANC_ONE}, {0}};
static const anc_setting mov_fixed[] = {{"step_size", 0, 0, ANC_ONE}, {"modified", 0, 1, ANC_ONE}, {"penalty_factor", 0, 0, ANC_EACH_LOUDSPEAKER}, {0}};

static int descend_mov(signals *s, const real *error, const real *fixed)
{
    const int refused = estimate(s, error);
    const real mu = *s->setting[STEP_SIZE];
    if (refused) return refused;
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        const real gamma = fixed ? fixed[sj % s->J] : penalty_of_constraint(s->previewed + sj);
        set_step(s, sj, 1, mu, mu * gamma * s->control[sj]);
    }
    if (*s->setting[MODIFIED] == 0) return descend(s, error);
    for (int32_t sk = 0; sk < s->S * s->K; sk++) s->estimate[sk] -= heard_output(s, &s->filtered, sk / s->K, sk % s->K);
    return descend(s, s->estimate);
}

static int update_mov(anc_view *view, const real *error) { return error ? descend_mov((signals *)view, error, NULL) : ANC_DONE; }

static int update_mov_fixed(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    return error ? descend_mov(s, error, s->setting[PENALTY_FACTOR]) : ANC_DONE;
}

const anc_algorithm anc_mov = {"MOV-FxLMS", mov, layout_plain, start_plain, filtered_signal, update_mov, NULL};
const anc_algorithm anc_mov_fixed = {"MOV-FxLMS fixed", mov_fixed, layout_plain, start_plain, filtered_signal, update_mov_fixed, NULL};

/* Two-gradient FxLMS (Shi et al. 2019): FxLMS while |y(n)| <= A, else w(n+1) = w(n) - mu_y y(n) x(n). */

enum { AMPLITUDE_LIMIT = STEP_SIZE + 1, OUTPUT_STEP_SIZE };
static const anc_setting two_gradient[] = {{"step_size", 0, 0, ANC_ONE}, {"amplitude_limit", 0, 0, ANC_EACH_LOUDSPEAKER}, {"output_step_size", 0, 0, ANC_ONE}, {0}};

static int update_two_gradient(anc_view *view, const real *error)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = estimate(s, error);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        const real y = s->control[sj];
        if (within(y, s->setting[AMPLITUDE_LIMIT][sj % s->J])) set_step(s, sj, 1, *s->setting[STEP_SIZE], 0);
        else set_step(s, sj, 1, 0, *s->setting[OUTPUT_STEP_SIZE] * y);
    }
    return refused ? refused : descend(s, error);
}

const anc_algorithm anc_two_gradient = {"two-gradient FxLMS", two_gradient, layout_plain, start_plain, filtered_signal, update_two_gradient, NULL};

/* Clipping FxLMS (Qiu and Hansen 2001): y(n) is clipped to A; re-scaling FxLMS: and w scaled by A / |y(n)|. Then FxLMS. */

static const anc_setting limited[] = {{"step_size", 0, 0, ANC_ONE}, {"amplitude_limit", 0, 0, ANC_EACH_LOUDSPEAKER}, {0}};

static int limited_signal(anc_view *view, const real *reference, real *control, int rescaling)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    for (int32_t sj = 0; !refused && sj < s->S * s->J; sj++) {
        const real limit = s->setting[AMPLITUDE_LIMIT][sj % s->J];
        real y = filter_output(s, sj);
        if (!within(y, limit)) {
            const real clipped = y > 0 ? limit : -limit, ratio = clipped / y;
            for (int32_t i = 0; rescaling && i < s->I * s->L; i++) weights_of(s, sj)[i] *= ratio;
            y = clipped;
        }
        emit(s, sj, y), control[sj] = s->control[sj];
    }
    return refused;
}

static int control_signal_clipping(anc_view *view, const real *reference, real *control) { return limited_signal(view, reference, control, 0); }
static int control_signal_rescaling(anc_view *view, const real *reference, real *control) { return limited_signal(view, reference, control, 1); }

const anc_algorithm anc_clipping = {"clipping FxLMS", limited, layout_plain, start_plain, control_signal_clipping, update_fxlms, NULL};
const anc_algorithm anc_rescaling = {"re-scaling FxLMS", limited, layout_plain, start_plain, control_signal_rescaling, update_fxlms, NULL};
