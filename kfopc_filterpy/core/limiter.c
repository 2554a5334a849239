/* A limiter: the mean square of its output over a sliding window never exceeds the rated power. Energies are in units of the
 * budget N rho_o. The energy of a window is the sum over this lap plus the part of the last lap that is still in the window;
 * only squares are summed, and the sums restart every N samples, so that no rounding accumulates. */
#include "signals.h"

static const real OVERSHOOT = (real)1.1; /* the gain rises towards this multiple of its aim and stops at the aim, so that it reaches 1 */
const anc_real anc_limiter_reserve = (real)0.02; /* of the power: keeps a tone's gain constant even if the window holds no whole periods */
#ifdef ANC_FLOAT
const anc_real anc_limiter_floor = 1e-30f; /* of the budget: keeps estimates above denormal numbers, which are slow */
#else
const anc_real anc_limiter_floor = 1e-200;
#endif

static real least(real a, real b) { return b < a ? b : a; }
static real largest(real a, real b) { return b > a ? b : a; }

/* At position i of a lap, laps_out[k] is minus this lap's output energy up to k for k < i, the last lap's from k on for k > i, and
 * 0 for k = N: for any m <= N, the energy of the last m samples is one sum. laps_in holds the same for the input. */
typedef struct { real *laps_out, *laps_in, *squares; } rows;

/* Return the largest constant gain that keeps to the budget over every horizon for the worst input expected. In the next h samples
 * that is the least of three: the largest recent energy of h samples; h times the present loudness; and what would make the window
 * as loud as the largest one known, unless the present window is louder already. */
static real aim(anc_limiter *c, rows r, int32_t i, int32_t size)
{
    real known = (1 + anc_limiter_reserve) * c->known, room = 1;
    if (c->arrived + r.laps_in[i + 1] > known) known = (real)INFINITY;
    for (int32_t j = 0; j < (int32_t)c->spans; j++) {
        const int32_t h = (int32_t)c->horizon[j];
        const int32_t before = i >= h ? i - h : i - h + size + 1;
        c->held[j] = largest(largest(c->held[j] * c->fade, c->arrived + r.laps_in[before]), anc_limiter_floor);
        const int32_t kept = i + h <= size ? i + h : i + h - size - 1; /* where the last N - h samples begin */
        const real coming = least(least(c->held[j], (real)h * c->loud), known - (c->arrived + r.laps_in[kept]));
        const real left = least(1 - (c->spent + r.laps_out[kept]), c->room[j]);
        room = least(room, left / largest(coming, anc_limiter_floor));
    }
    return root(largest(room, 0));
}

/* Start a new lap; the one just completed becomes the last one. */
static void start_lap(anc_limiter *c, rows r, int32_t size)
{
    real rest = 0;
    for (int32_t k = size - 1; k > 0; k--) {
        rest += r.squares[k]; /* summed from scratch, without differences: the guarantee depends on it */
        r.laps_out[k] = rest;
        r.laps_in[k] = c->arrived + r.laps_in[k - 1];
    }
    c->position = c->spent = c->arrived = 0;
    c->known = c->held[(int32_t)c->spans - 1];
}

real anc_limit(anc_limiter *c, real *laps, real u)
{
    const int32_t size = (int32_t)c->size, i = (int32_t)c->position;
    const rows r = {laps, laps + size + 1, laps + 2 * ((size_t)size + 1)};
    if (!isfinite(u)) return (real)NAN;
    const real wide = least(u < 0 ? -u : u, c->planned) * c->scale, energy = wide * wide;
    c->arrived += energy;
    r.laps_in[i] = -c->arrived;
    c->average = largest(c->average + c->attack * (energy - c->average), anc_limiter_floor);
    c->loud = largest(c->loud * c->calm, c->average);
    const real wanted_gain = aim(c, r, i, size);
    c->gain = least(wanted_gain, c->gain + c->release * largest(OVERSHOOT * wanted_gain - c->gain, 0));
    const real wanted = c->gain * u;
    real y = least(largest(wanted, -c->limit), c->limit), square = (y * c->scale) * (y * c->scale);
    const real left = c->budget - (c->spent + r.laps_out[i + 1]);
    if (square > left) { /* the guarantee; the gain above makes this rare */
        y = c->peak * root(largest(left, 0));
        if (u < 0) y = -y;
        square = (y * c->scale) * (y * c->scale);
    }
    if (y != wanted) c->clipped += 1;
    c->spent += square;
    r.laps_out[i] = -c->spent, r.squares[i] = square;
    c->position = (real)(i + 1);
    if (i + 1 == size) start_lap(c, r, size);
    return y;
}

void anc_limit_all(anc_limiter *c, real *laps, const real *input, real *output, int64_t n)
{
    for (int64_t t = 0; t < n; t++) output[t] = anc_limit(c, laps, input[t]);
}
