/* KF-OPC with its gain repaired: three changes of eq. 11-13, alone or together.
 *
 * Eq. 13 keeps the rated power if the secondary path is flat over the noise and the disturbance can be cancelled
 * completely. On other paths, control signal and reference have different spectra. Therefore G_s is that of the control
 * signal, E[(s^ * y)^2] / E[y^2]; the measured output power trims the factor; and the factor acts on the output,
 * at once. */
#include "kalman.h"

enum { OF_CONTROL = KALMAN_SETTINGS, TRIM_RATE, AT_OUTPUT };
static const anc_setting repaired_settings[] = {
    KALMAN_SETTINGS_LISTED, {"of_control", 0, 1, ANC_ONE}, {"trim_rate", 0, 0, ANC_ONE}, {"at_output", 0, 1, ANC_ONE}, {0}};
static const real MOST_TRIM = 10;

static void layout_repaired(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at)
{
    kalman *f = (kalman *)view;
    layout_kalman(view, plan, settings, at);
    f->trim = reals(at, "trim", ANC_STATE, 1, f->s.S, f->s.J, TRIMS);
}

static void start_repaired(anc_view *view, const anc_plan *plan, const anc_setting *settings)
{
    kalman *f = (kalman *)view;
    start_kalman(view, plan, settings);
    for (int32_t n = 0; n < f->s.S * f->s.J * TRIMS; n++) f->trim[n] = 1;
}

static int control_signal_repaired(anc_view *view, const real *reference, real *control)
{
    kalman *f = (kalman *)view;
    signals *s = &f->s;
    const int refused = take_reference(s, reference);
    for (int32_t sj = 0; !refused && sj < s->S * s->J; sj++) {
        emit(s, sj, f->trim[TRIMS * sj + OUTPUT_GAIN] * filter_output(s, sj));
        control[sj] = s->control[sj];
    }
    return refused;
}

/* Put the squares of s^ * y and y in place of those of x' and x (eq. 11). */
static void observe_control(signals *s)
{
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        real f2 = 0;
        for (int32_t k = 0; k < s->K; k++) {
            const real f = dot(s->path + times(k * s->J + sj % s->J, s->M), newest(&s->y, sj), s->M);
            f2 += f * f;
        }
        s->squares[ANC_POWERS * sj + ANC_FILTERED] = f2;
        s->squares[ANC_POWERS * sj + ANC_REFERENCE] = s->control[sj] * s->control[sj];
    }
}

/* Return exp(c), by sums and products only, since the exp of math libraries differs. Any |c| above 5 takes a trim
 * to its bound. */
static real growth(real c)
{
    const real part = (c > 5 ? 5 : c > -5 ? c : -5) / 16;
    real power = 1;
    for (int n = 10; n > 0; n--) power = 1 + part * power / (real)n;
    for (int n = 0; n < 4; n++) power *= power;
    return power;
}

/* Trim the next factor by the power of y: up if it is below the rated power, else down. At a factor of 1 the trim does
 * not rise, so that it does not wind up. */
static void advance_trim(kalman *f, int32_t sj)
{
    const signals *s = &f->s;
    const real y = s->control[sj], factor = s->constraint[sj].factor;
    const real change = *s->setting[TRIM_RATE] * (1 - y * y / s->constraint[sj].rated_power);
    real *trim = f->trim + TRIMS * sj;
    if (change < 0 || factor < 1) {
        trim[TRIM] *= growth(change);
        if (trim[TRIM] > MOST_TRIM) trim[TRIM] = MOST_TRIM;
        if (!(trim[TRIM] >= 1 / MOST_TRIM)) trim[TRIM] = 1 / MOST_TRIM;
    }
    if (*s->setting[AT_OUTPUT] != 0) trim[OUTPUT_GAIN] = factor;
}

static int update_repaired(anc_view *view, const real *error)
{
    kalman *f = (kalman *)view;
    signals *s = &f->s;
    if (!error) return ANC_DONE;
    int refused = estimate_disturbance(s, error);
    if (refused) return refused;
    if (*s->setting[OF_CONTROL] != 0) observe_control(s);
    preview(s);
    for (int32_t sj = 0; sj < s->S * s->J; sj++) {
        const real factor = s->previewed[sj].factor * f->trim[TRIMS * sj + TRIM];
        s->previewed[sj].factor = factor < 1 ? factor : 1;
    }
    for (int32_t sk = 0; sk < s->S * s->K; sk++)
        f->scaled[sk] = (*s->setting[AT_OUTPUT] != 0 ? 1 : least_factor(s, sk / s->K)) * s->estimate[sk];
    refused = correct_weights(f);
    for (int32_t sj = 0; !refused && sj < s->S * s->J; sj++) advance_trim(f, sj);
    return refused;
}

const anc_algorithm anc_repaired = {"KF-OPC repaired", repaired_settings, layout_repaired, start_repaired, control_signal_repaired, update_repaired, NULL};
