/* FxLMS (Morgan 1980), with several channels the multiple-error LMS (Elliott 1987), and relatives.
 * Each is the step that it makes with the weights of a loudspeaker:
 *
 *     w_ji(n+1) = keep_j w_ji(n) + mu_j sum_k e_k(n) x'_kji(n) - penalty_j x_i(n) */
#include "signals.h"

enum { STEP_SIZE }; /* the first setting of all */

typedef lms_step step_of(const signals *s, int32_t sj);

/* Estimate d^, and set the steps. Return whether to go on: ANC_DONE, or why not. */
static int set_steps(signals *s, const real *error, step_of *step)
{
    const int refused = estimate(s, error);
    for (int32_t sj = 0; !refused && sj < s->S * s->J; sj++) s->step[sj] = step(s, sj);
    return refused;
}

/* Update the weights by the steps of an algorithm. */
static int update(anc_view *view, const real *error, step_of *step)
{
    signals *s = (signals *)view;
    if (!error) return ANC_DONE;
    const int refused = set_steps(s, error, step);
    return refused ? refused : descend(s, error);
}

/* FxLMS: w(n+1) = w(n) + mu e(n) x'(n). */

static const anc_setting fxlms[] = {{"step_size", 0, 0, ANC_ONE}, {0}};

static lms_step fxlms_step(const signals *s, int32_t sj)
{
    (void)sj;
    return (lms_step){1, *s->setting[STEP_SIZE], 0};
}

static int update_fxlms(anc_view *v, const real *e) { return update(v, e, fxlms_step); }

const anc_algorithm anc_fxlms = {
    .name = "FxLMS", .settings = fxlms, .control_signal = filtered_signal, .update = update_fxlms};

/* FxNLMS: w(n+1) = w(n) + mu e(n) x'(n) / (epsilon + x'(n)'x'(n)), with the energy of all filtered
 * references. A soft reference teaches little but the noise of the microphones. So if epsilon is 0,
 * two things hold.
 *
 * The energy counts as at least QUIET of the usual one, which follows a louder signal within a
 * filter length, by at most e^RISE, so that a bad sample does not count, and a softer one within
 * HELD filter lengths.
 *
 * When a reference is UNHEARD times as loud as those that the weights were learned from, they begin
 * anew, and stay 0 until the path has passed it on: so long, x' is still the soft one. What they
 * were learned from follows within HELD filter lengths, and at first, while the weights are younger
 * than YOUNG filter lengths, a louder reference at once. */

enum { REGULARIZATION = STEP_SIZE + 1 };
static const real QUIET = (real)1e-3, RISE = 4, HELD = 1000, UNHEARD = (real)1e4, YOUNG = 2;
typedef struct {
    signals s;
    real *usual;   /* energy of the filtered references */
    real *learned; /* energy of the references that the weights were learned from */
    real *age;     /* of the weights, in samples; below 0 they wait */
    real *over;    /* what the step size is divided by */
} normalised;
static const anc_setting fxnlms[] = {
    {"step_size", 0, 0, ANC_ONE}, {"regularization", 0, 0, ANC_ONE}, {0}};

static void layout_fxnlms(anc_view *view, const anc_plan *plan, anc_layout *at)
{
    normalised *f = (normalised *)view;
    (void)plan;
    f->usual = reals(at, "usual_energy", ANC_STATE, 1, 1, 1, 1);
    f->learned = reals(at, "learned_energy", ANC_STATE, 1, 1, 1, 1);
    f->age = reals(at, "age", ANC_STATE, 1, 1, 1, 1);
    f->over = reals(at, "regularized_energy", ANC_SCRATCH, 1, 1, 1, 1);
}

static int fxnlms_signal(anc_view *view, const real *reference, real *control)
{
    normalised *f = (normalised *)view;
    signals *s = &f->s;
    const int refused = take_reference(s, reference);
    if (refused) return refused;
    real x2 = 0;
    for (int32_t i = 0; i < s->I; i++) x2 += *newest(&s->x, i) * *newest(&s->x, i);
    const int unheard = *f->learned > 0 && x2 * (real)s->L > UNHEARD * *f->learned;
    if (unheard && *s->setting[REGULARIZATION] == 0) {
        clear(s->weights, times(s->S, states(s)));
        *f->learned = 0;
        *f->age = 1 - (real)s->M;
    }
    emit_all(s, control);
    return ANC_DONE;
}

static lms_step fxnlms_step(const signals *s, int32_t sj)
{
    const real over = *((const normalised *)s)->over;
    (void)sj;
    return (lms_step){1, over > 0 ? *s->setting[STEP_SIZE] / over : 0, 0};
}

static int update_fxnlms(anc_view *view, const real *error)
{
    normalised *f = (normalised *)view;
    const signals *s = &f->s;
    if (!error) return ANC_DONE;
    const real energy = filtered_energy(s), heard = energy_of(s, &s->x, 0, s->I), L = (real)s->L;
    const real usual = *f->usual > 0 ? *f->usual : energy, slow = 1 / (HELD * L);
    const real epsilon = *s->setting[REGULARIZATION];
    const int learns = energy > 0 && *f->age >= 0;
    *f->over = epsilon > 0 ? epsilon + energy : learns ? larger(energy, QUIET * usual) : 0;
    const int refused = update(view, error, fxnlms_step);
    if (refused) return refused;
    *f->usual = flushed(held_value(usual, energy, 1 - slow, 1 + RISE / L));
    if (heard == 0) return ANC_DONE; /* nothing is learned from silence */
    *f->learned = *f->age < YOUNG * L ? larger(*f->learned, heard)
                                      : held_value(*f->learned, heard, 1 - slow, 1 + slow);
    *f->age += 1;
    return ANC_DONE;
}

const anc_algorithm anc_fxnlms = {.name = "FxNLMS",
                                  .settings = fxnlms,
                                  .layout = layout_fxnlms,
                                  .control_signal = fxnlms_signal,
                                  .update = update_fxnlms};

/* Leaky FxLMS: w(n+1) = (1 - mu gamma) w(n) + mu e(n) x'(n). */

enum { LEAK = STEP_SIZE + 1 };
static const anc_setting leaky[] = {
    {"step_size", 0, 0, ANC_ONE}, {"leak", 0, 0, ANC_EACH_LOUDSPEAKER}, {0}};

static lms_step leaky_step(const signals *s, int32_t sj)
{
    const real mu = *s->setting[STEP_SIZE], gamma = s->setting[LEAK][sj % s->J];
    return (lms_step){1 - mu * gamma, mu, 0};
}

static int update_leaky(anc_view *v, const real *e) { return update(v, e, leaky_step); }

const anc_algorithm anc_leaky = {.name = "leaky FxLMS",
                                 .settings = leaky,
                                 .control_signal = filtered_signal,
                                 .update = update_leaky};

/* Optimal leaky FxLMS: the same with gamma(n) = E[x^2] G_s (1 / alpha - 1). */

/* Return G_s (1 / alpha - 1): 0 if the rated power is enough, and until a signal has passed the
 * estimated path. */
static real penalty_of_constraint(const anc_previewed *p)
{
    return p->factor < 1 && p->gain > 0 ? p->gain * (1 / p->factor - 1) : 0;
}

static lms_step optimal_step(const signals *s, int32_t sj)
{
    const anc_previewed *p = s->previewed + sj;
    const real mu = *s->setting[STEP_SIZE];
    const real gamma = penalty_of_constraint(p) * p->mean[ANC_REFERENCE];
    return (lms_step){larger(1 - mu * gamma, 0), mu, 0};
}

static int update_optimal(anc_view *v, const real *e) { return update(v, e, optimal_step); }

const anc_algorithm anc_optimal_leaky = {.name = "optimal leaky FxLMS",
                                         .settings = fxlms,
                                         .control_signal = filtered_signal,
                                         .update = update_optimal};

/* MOV-FxLMS: w(n+1) = w(n) + mu [e(n) x'(n) - gamma y(n) x(n)], with gamma = G_s (1 / alpha - 1),
 * or a fixed one. Modified, it adapts to d^ - w'x' in place of the error. */

enum { MODIFIED = STEP_SIZE + 1, PENALTY_FACTOR };
static const anc_setting mov[] = {{"step_size", 0, 0, ANC_ONE}, {"modified", 0, 1, ANC_ONE}, {0}};
static const anc_setting mov_fixed[] = {{"step_size", 0, 0, ANC_ONE},
                                        {"modified", 0, 1, ANC_ONE},
                                        {"penalty_factor", 0, 0, ANC_EACH_LOUDSPEAKER},
                                        {0}};

static lms_step mov_step(const signals *s, int32_t sj)
{
    const real mu = *s->setting[STEP_SIZE], gamma = penalty_of_constraint(s->previewed + sj);
    return (lms_step){1, mu, mu * gamma * s->control[sj]};
}

static lms_step fixed_step(const signals *s, int32_t sj)
{
    const real mu = *s->setting[STEP_SIZE], gamma = s->setting[PENALTY_FACTOR][sj % s->J];
    return (lms_step){1, mu, mu * gamma * s->control[sj]};
}

/* Update by steps that adapt to d^ - w'x' if the setting says so. */
static int modified(anc_view *view, const real *error, step_of *step)
{
    signals *s = (signals *)view;
    if (!error || *s->setting[MODIFIED] == 0) return update(view, error, step);
    const int refused = set_steps(s, error, step);
    if (refused) return refused;
    for (int32_t sk = 0; sk < s->S * s->K; sk++)
        s->estimate[sk] -= heard_output(s, &s->filtered, sk / s->K, sk % s->K);
    return descend(s, s->estimate);
}

static int update_mov(anc_view *v, const real *e) { return modified(v, e, mov_step); }

static int update_fixed(anc_view *v, const real *e) { return modified(v, e, fixed_step); }

const anc_algorithm anc_mov = {
    .name = "MOV-FxLMS", .settings = mov, .control_signal = filtered_signal, .update = update_mov};
const anc_algorithm anc_mov_fixed = {.name = "MOV-FxLMS fixed",
                                     .settings = mov_fixed,
                                     .control_signal = filtered_signal,
                                     .update = update_fixed};

/* Two-gradient FxLMS (Shi et al. 2019): FxLMS while |y(n)| <= A, else
 * w(n+1) = w(n) - mu_y y(n) x(n). */

enum { AMPLITUDE_LIMIT = STEP_SIZE + 1, OUTPUT_STEP_SIZE };
static const anc_setting two_gradient[] = {{"step_size", 0, 0, ANC_ONE},
                                           {"amplitude_limit", 0, 0, ANC_EACH_LOUDSPEAKER},
                                           {"output_step_size", 0, 0, ANC_ONE},
                                           {0}};

static lms_step gradients_step(const signals *s, int32_t sj)
{
    const real y = s->control[sj];
    if (within(y, s->setting[AMPLITUDE_LIMIT][sj % s->J])) return fxlms_step(s, sj);
    return (lms_step){1, 0, *s->setting[OUTPUT_STEP_SIZE] * y};
}

static int update_gradients(anc_view *v, const real *e) { return update(v, e, gradients_step); }

const anc_algorithm anc_two_gradient = {.name = "two-gradient FxLMS",
                                        .settings = two_gradient,
                                        .control_signal = filtered_signal,
                                        .update = update_gradients};

/* Clipping FxLMS (Qiu and Hansen 2001): y(n) is clipped to A. Re-scaling FxLMS: w is scaled by
 * A / |y(n)|, too. Then FxLMS. */

static const anc_setting limited[] = {
    {"step_size", 0, 0, ANC_ONE}, {"amplitude_limit", 0, 0, ANC_EACH_LOUDSPEAKER}, {0}};

static int limited_signal(anc_view *view, const real *reference, real *control, int rescaling)
{
    signals *s = (signals *)view;
    const int refused = take_reference(s, reference);
    if (refused) return refused;
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        const real limit = s->setting[AMPLITUDE_LIMIT][sj % s->J];
        real y = filter_output(s, sj);
        if (!within(y, limit)) {
            const real clipped = y > 0 ? limit : -limit, ratio = clipped / y;
            real *w = weights_of(s, sj);
            for (int32_t i = 0; rescaling && i < s->I * s->L; i++) w[i] *= ratio;
            y = clipped;
        }
        emit(s, sj, y);
        control[sj] = s->control[sj];
    }
    return ANC_DONE;
}

static int clipped_signal(anc_view *view, const real *reference, real *control)
{
    return limited_signal(view, reference, control, 0);
}

static int rescaled_signal(anc_view *view, const real *reference, real *control)
{
    return limited_signal(view, reference, control, 1);
}

const anc_algorithm anc_clipping = {.name = "clipping FxLMS",
                                    .settings = limited,
                                    .control_signal = clipped_signal,
                                    .update = update_fxlms};
const anc_algorithm anc_rescaling = {.name = "re-scaling FxLMS",
                                     .settings = limited,
                                     .control_signal = rescaled_signal,
                                     .update = update_fxlms};
