/* A controller of one channel, from anc_open on: RUN samples of any reference and any error. */
#include "signals.h"
#include "any.h"
#include "shape.h" /* ALGORITHM, SETTINGS, WINDOW of the powers, RUN, CHANNELS */

enum { MOST = 8192, TAPS = 2 };
static double block[MOST];
static anc_view view;

int main(void)
{
    static const int32_t windows[] = {WINDOW, WINDOW};
    static const anc_real path[TAPS * CHANNELS * CHANNELS] = {0.5, 0.25}, settings[] = {SETTINGS};
    const anc_plan plan = {.scenarios = 1,
                           .microphones = CHANNELS,
                           .loudspeakers = CHANNELS,
                           .references = CHANNELS,
                           .taps = TAPS,
                           .path_taps = TAPS,
                           .power_windows = windows,
                           .path = path,
                           .settings = settings};
    if (!anc_open(&ALGORITHM, &plan, &view, block, sizeof block, 1)) return 1;
    for (int n = 0; n < RUN; n++) {
        anc_real x[CHANNELS], e[CHANNELS], y[CHANNELS];
        for (int i = 0; i < CHANNELS; i++) x[i] = any();
        for (int i = 0; i < CHANNELS; i++) e[i] = any();
        if (!ALGORITHM.control_signal(&view, x, y)) ALGORITHM.update(&view, e);
    }
    return 0;
}
