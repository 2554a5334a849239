/* The three amplifiers, one call. */
#include "anc.h"
#include "any.h"

int main(void)
{
    const anc_amplifier a = {.kind = Frama_C_interval(0, 2),
                             .limit = Frama_C_double_interval(1e-6, 1e6),
                             .sharpness = Frama_C_double_interval(0.1, 20)};
    const double y = anc_amplify(&a, any());
    return y > 0;
}
