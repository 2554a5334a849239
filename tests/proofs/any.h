/* Any bit pattern, NaN and infinities included; reading an `extern volatile double` would give
 * finite values only. */
#include "__fc_builtin.h"

static double any(void)
{
    union {
        unsigned long bits;
        double value;
    } a = {Frama_C_unsigned_long_interval(0, ~0ul)};
    return a.value;
}
