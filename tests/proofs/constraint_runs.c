/* The powers and the constraint factor of one loudspeaker, for ever. */
#include "signals.h"
#include "any.h"
#include "shape.h" /* LENGTH of the windows; 0: exponential */

static anc_power powers[ANC_POWERS];
static double window[ANC_POWERS * (LENGTH + 1)];

int main(void)
{
    anc_constraint c = {.rated_power = 1,
                        .rate = 0.01,
                        .supplied_factor = NAN,
                        .supplied_power = NAN,
                        .supplied_gain = NAN,
                        .factor = 1,
                        .gain = NAN};
    for (;;) {
        anc_previewed next = {.square = {any(), any(), any()}};
        anc_preview(&c, powers, window, LENGTH, &next);
        anc_commit(&c, powers, window, LENGTH, &next);
    }
}
