/* Memoryless amplifier models: linear, hard clip, and Rapp's soft saturation. */
#include "signals.h"

/* Return base^exponent for a base and an exponent of at least 0, by squares and square roots:
 * libm's pow differs between machines. */
static real power(real base, real exponent)
{
    const real most = 1 << 20; /* of the exponent */
    if (exponent > most) return base > 1 ? (real)INFINITY : base < 1 ? 0 : 1;
    const int32_t whole = (int32_t)exponent;
    real result = raised(base, whole), share = base, rest = exponent - (real)whole;
    while (rest > 0 && share != 1) { /* the binary digits of the fraction */
        share = root(share);
        rest *= 2;
        if (rest >= 1) {
            result *= share;
            rest -= 1;
        }
    }
    return result;
}

/* Return y / (1 + |y / a|^2p)^(1 / 2p); for |y| > a with |a / y|, which does not overflow. */
static real saturated(const anc_amplifier *amplifier, real y)
{
    const real a = amplifier->limit, p = amplifier->sharpness, ratio = (real)fabs(y) / a;
    if (ratio <= 1) return y / power(1 + power(ratio, 2 * p), (real)0.5 / p);
    return (y < 0 ? -a : a) / power(1 + power(1 / ratio, 2 * p), (real)0.5 / p);
}

real anc_amplify(const anc_amplifier *amplifier, real y)
{
    const real a = amplifier->limit;
    if (amplifier->kind == (real)ANC_SOFT_SATURATION) return saturated(amplifier, y);
    if (amplifier->kind == (real)ANC_HARD_CLIP && (real)fabs(y) > a) return y < 0 ? -a : a;
    return y;
}

void anc_amplify_all(const anc_amplifier *amplifier, const real *input, real *output, int64_t n)
{
    for (int64_t t = 0; t < n; t++) output[t] = anc_amplify(amplifier, input[t]);
}
