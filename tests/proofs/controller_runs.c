/* A controller, from anc_open on, for ever: any reference and any error, whether it controls or
 * only listens, adapts or not. */
#include "signals.h"
#include "any.h"
#include "shape.h" /* ALGORITHM and its SETTINGS, and how many there are of what a plan has */

enum {
    MOST = 32768,
    MODELS = MODELLED * MICROPHONES, /* references of an internal model */
    ALL_OUT = SCENARIOS * LOUDSPEAKERS,
    ALL_HEARD = SCENARIOS * MICROPHONES
};
static double block[MOST];
static anc_view view;

static void any_numbers(anc_real *to, int n)
{
    for (int i = 0; i < n; i++) to[i] = any();
}

int main(void)
{
    static const int32_t windows[ALL_OUT] = {WINDOW};
    static const int32_t limiters[] = {LIMITER, LIMITER, LIMITER, LIMITER};
    const anc_real settings[] = {SETTINGS};
    anc_real path[PATH_TAPS * MICROPHONES * LOUDSPEAKERS], guard[GUARD + 1];
    any_numbers(path, PATH_TAPS * MICROPHONES * LOUDSPEAKERS);
    any_numbers(guard, GUARD);
    const anc_plan plan = {.scenarios = SCENARIOS,
                           .microphones = MICROPHONES,
                           .loudspeakers = LOUDSPEAKERS,
                           .references = REFERENCES + MODELS,
                           .taps = TAPS,
                           .path_taps = PATH_TAPS,
                           .guard_taps = GUARD,
                           .modelled = MODELLED,
                           .power_windows = windows,
                           .limiter_windows = limiters,
                           .path = path,
                           .guard = guard,
                           .settings = settings};
    if (!anc_open(&ALGORITHM, &plan, &view, block, sizeof block, 1)) return 1;
    ((signals *)&view)->amplifier[0] = (anc_amplifier){ANC_SOFT_SATURATION, 1, 2};
    for (;;) {
        anc_real x[REFERENCES], e[ALL_HEARD], y[ALL_OUT];
        any_numbers(x, REFERENCES);
        any_numbers(e, ALL_HEARD);
        if (Frama_C_interval(0, 1)) {
            const uint8_t adapt = Frama_C_interval(0, 1);
            int32_t answer;
            anc_listen(&ALGORITHM, &view, x, e, &adapt, 1, &answer);
        } else if (!ALGORITHM.control_signal(&view, x, y)) {
            if (Frama_C_interval(0, 1)) anc_take_error(&view, e);
            ALGORITHM.update(&view, Frama_C_interval(0, 1) ? e : NULL);
        }
    }
}
