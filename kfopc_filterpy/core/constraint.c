/* Eq. 10-13: running powers of disturbance, filtered reference and reference, and the constraint factor. */
#include "signals.h"

/* Below the smallest normal number, a ratio of powers has no digits left: such a signal counts as silent. */
#ifdef ANC_FLOAT
static const real SILENCE = FLT_MIN;
#else
static const real SILENCE = DBL_MIN;
#endif

/* Return the mean square with one more square in it: of all until the memory is full, then of the window or exponential. */
static real next_mean(const anc_power *p, const real *window, int32_t length, real rate, real square)
{
    if (!length) {
        const real share = rate * (p->taken + 1) < 1 ? 1 / (p->taken + 1) : rate;
        return p->mean_square + share * (square - p->mean_square);
    }
    const int32_t i = (int32_t)p->position;
    const real rest = i + 1 < length ? window[i + 1] : 0; /* of the last lap; sums only, so that no rounding accumulates */
    const real samples = p->taken + 1 < (real)length ? p->taken + 1 : (real)length;
    return (p->lap + square + rest) / samples;
}

void anc_preview(const anc_constraint *c, const anc_power *powers, const real *window, int32_t length, anc_previewed *next, real d2, real f2, real x2)
{
    const real square[ANC_POWERS] = {d2, f2, x2};
    for (int i = 0; i < ANC_POWERS; i++) {
        const int kept = i != ANC_DISTURBANCE && isnan(x2);
        next->mean[i] = kept ? powers[i].mean_square : next_mean(powers + i, window + times(i, length), length, c->rate, square[i]);
    }
    /* G_s = E[x'^2] / E[x^2] (eq. 11), or the last one while the reference is silent */
    next->gain = c->gain;
    if (!isnan(c->supplied_gain)) next->gain = c->supplied_gain;
    else if (next->mean[ANC_REFERENCE] > SILENCE) next->gain = next->mean[ANC_FILTERED] / next->mean[ANC_REFERENCE];
    next->power = isnan(c->supplied_power) ? next->mean[ANC_DISTURBANCE] : c->supplied_power;
    /* alpha = min(sqrt(rho_o G_s / delta_d^2), 1) (eq. 13); 1 without a disturbance or a gain */
    next->factor = 1;
    if (!isnan(c->supplied_factor)) next->factor = c->supplied_factor;
    else if (next->power > SILENCE && !isnan(next->gain)) {
        const real factor = root(c->rated_power * next->gain / next->power);
        if (factor < 1) next->factor = factor;
    }
}

void anc_commit(anc_constraint *c, anc_power *powers, real *window, int32_t length, const anc_previewed *next, real d2, real f2, real x2)
{
    const real square[ANC_POWERS] = {d2, f2, x2};
    c->factor = next->factor, c->power = next->power, c->gain = next->gain;
    for (int i = 0; i < ANC_POWERS; i++) {
        anc_power *p = powers + i;
        real *lap = window + times(i, length);
        if (i != ANC_DISTURBANCE && isnan(x2)) continue;
        p->mean_square = next->mean[i];
        p->taken += 1;
        if (!length) continue;
        /* window[k] is this lap's square for k < position, and the last lap's sum from k on for the others */
        const int32_t at = (int32_t)p->position;
        p->lap += square[i];
        lap[at] = square[i];
        p->position = (real)(at + 1);
        if (at + 1 < length) continue;
        p->lap = p->position = 0;
        for (int32_t k = length - 2; k >= 0; k--) lap[k] += lap[k + 1];
    }
}
