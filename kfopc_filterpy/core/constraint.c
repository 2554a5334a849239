/* Eq. 10-13: running powers of disturbance, filtered reference and reference, and the constraint
 * factor alpha. */
#include "signals.h"

/* Return the mean square with one more square in it: of all until the memory is full, then of the
 * window, or exponential if the length is 0. */
static real next_mean(const anc_power *p, const real *window, int32_t length, real rate,
                      real square)
{
    const real taken = p->taken + 1;
    if (!length) {
        const real share = rate * taken < 1 ? 1 / taken : rate;
        return flushed(p->mean_square + share * (square - p->mean_square));
    }
    /* The sum over this lap, and the rest of the last lap: no difference, whose rounding would
     * stay. */
    const int32_t i = (int32_t)p->position;
    const real rest = i + 1 < length ? window[i + 1] : 0;
    return (p->lap + square + rest) / smaller(taken, (real)length);
}

/* Return whether a power takes the sample: those of x' and x only if a reference was given. */
static int is_taken(const anc_previewed *next, int power)
{
    return power == ANC_DISTURBANCE || !isnan(next->square[ANC_REFERENCE]);
}

void anc_preview(const anc_constraint *c, const anc_power *powers, const real *window,
                 int32_t length, anc_previewed *next)
{
    for (int i = 0; i < ANC_POWERS; i++) {
        const real *lap = window + times(i, length);
        next->mean[i] = is_taken(next, i)
                            ? next_mean(powers + i, lap, length, c->rate, next->square[i])
                            : powers[i].mean_square;
    }
    /* Below SMALLEST, a ratio of powers has no digits left: such a signal counts as silent. */
    const real d2 = next->mean[ANC_DISTURBANCE], x2 = next->mean[ANC_REFERENCE];
    /* G_s = E[x'^2] / E[x^2] (eq. 11), or the last one while the reference is silent */
    next->gain = c->gain;
    if (x2 > SMALLEST) next->gain = next->mean[ANC_FILTERED] / x2;
    if (!isnan(c->supplied_gain)) next->gain = c->supplied_gain;
    next->power = isnan(c->supplied_power) ? d2 : c->supplied_power;
    /* alpha = min(sqrt(rho_o G_s / delta_d^2), 1) (eq. 13); 1 without a disturbance or a gain */
    next->factor = 1;
    if (next->power > SMALLEST && !isnan(next->gain))
        next->factor = smaller(root(c->rated_power * next->gain / next->power), 1);
    if (!isnan(c->supplied_factor)) next->factor = c->supplied_factor;
}

/* Take a square into a window: lap[k] is this lap's square for k < position; for the others, it is
 * the last lap's sum from k on. */
static void take_into_window(anc_power *p, real *lap, int32_t length, real square)
{
    const int32_t at = (int32_t)p->position;
    p->lap += square;
    lap[at] = square;
    if (at + 1 < length) {
        p->position = (real)(at + 1);
        return;
    }
    p->lap = 0;
    p->position = 0;
    for (int32_t k = length - 2; k >= 0; k--) lap[k] += lap[k + 1];
}

void anc_commit(anc_constraint *c, anc_power *powers, real *window, int32_t length,
                const anc_previewed *next)
{
    c->factor = next->factor;
    c->power = next->power;
    c->gain = next->gain;
    for (int i = 0; i < ANC_POWERS; i++) {
        if (!is_taken(next, i)) continue;
        powers[i].mean_square = next->mean[i];
        powers[i].taken += 1;
        if (length)
            take_into_window(powers + i, window + times(i, length), length, next->square[i]);
    }
}
