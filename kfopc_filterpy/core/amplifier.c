/* Memoryless amplifier models: linear, hard clip, and Rapp's soft saturation. */
#include "signals.h"

/* Return base^exponent for a base and an exponent of at least 0, by squares and square roots: libm's pow differs between machines. */
static real power(real base, real exponent)
{
    const real most = 1 << 20; /* of the exponent */
    real result = 1, square = base, share = base;
    if (exponent > most) return base > 1 ? (real)INFINITY : base < 1 ? 0 : 1;
    int32_t whole = (int32_t)exponent;
    real rest = exponent - (real)whole;
    for (; whole; whole /= 2, square *= square)
        if (whole % 2) result *= square;
    while (rest > 0 && share != 1) { /* the binary digits of the fraction */
        share = root(share), rest *= 2;
        if (rest >= 1) result *= share, rest -= 1;
    }
    return result;
}

real anc_amplify(const anc_amplifier *a, real y)
{
    const real size = y < 0 ? -y : y;
    if (a->kind == (real)ANC_HARD_CLIP && size > a->limit) return y < 0 ? -a->limit : a->limit;
    if (a->kind == (real)ANC_SOFT_SATURATION) { /* y / (1 + |y / a|^2p)^(1 / 2p) */
        const real ratio = size / a->limit, p = a->sharpness;
        if (ratio <= 1) return y / power(1 + power(ratio, 2 * p), (real)0.5 / p);
        return (y < 0 ? -a->limit : a->limit) / power(1 + power(1 / ratio, 2 * p), (real)0.5 / p); /* which does not overflow */
    }
    return y;
}

void anc_amplify_all(const anc_amplifier *a, const real *input, real *output, int64_t n)
{
    for (int64_t t = 0; t < n; t++) output[t] = anc_amplify(a, input[t]);
}
