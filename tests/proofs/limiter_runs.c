/* A limiter with windows of 16 samples, for ever; its amplitude limit is 8. */
#include "anc.h"
#include "any.h"

enum { N = 16, SPANS = 4 };
static anc_limiter c = {
    .scale = 0.25,
    .peak = 3.9999999999999964,
    .budget = 0.99999999999999289,
    .limit = 8,
    .planned = 8,
    .attack = 0.1,
    .calm = 0.9,
    .fade = 0.99,
    .release = 0.4,
    .size = N,
    .spans = SPANS,
    .gain = 1,
    .horizon = {4, 8, 12, 16},
    .room = {1, 1, 1, 0.98},
};
static double laps[3 * (N + 1)];

int main(void)
{
    for (;;) {
        const double y = anc_limit(&c, laps, any());
        Frama_C_show_each_y(y);
    }
}
