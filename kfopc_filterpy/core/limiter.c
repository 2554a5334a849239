/* A limiter: the mean square of its output over a sliding window of N samples never exceeds the
 * rated power. Energies are in units of the budget N rho_o. The energy of a window is the sum over
 * this lap of N samples plus the part of the last lap that is still in the window. Only squares are
 * summed, and the sums restart every lap, so no rounding accumulates. */
#include "signals.h"

/* Of the power: keeps a tone's gain constant even if the window holds no whole periods. */
const anc_real anc_limiter_reserve = (real)0.02;
/* Of the budget: keeps estimates above denormal numbers, which are slow. */
#ifdef ANC_FLOAT
const anc_real anc_limiter_floor = 1e-30f;
#else
const anc_real anc_limiter_floor = 1e-200;
#endif
/* The gain rises towards this multiple of its aim and stops at the aim, so that it gets there. */
static const real OVERSHOOT = (real)1.1;

/* At position i of a lap, out[k] is minus this lap's output energy up to k for k < i, the last
 * lap's from k on for k > i, and 0 for k = N. So for any m <= N, the energy of the last m samples
 * is one sum. `in` holds the same for the input, `square` this lap's output energies one by one. */
typedef struct { real *out, *in, *square; } rows;

/* Return the largest constant gain that keeps to the budget over every horizon of h samples for the
 * worst input expected. That is the least of three: the largest recent energy of h samples; h times
 * the present loudness; and what would make the window as loud as the loudest one known, unless the
 * present window is louder already. */
static real aim(anc_limiter *c, rows r, int32_t i, int32_t N)
{
    const real window = c->arrived + r.in[i + 1];
    const real known = (1 + anc_limiter_reserve) * c->known;
    const real most = window > known ? (real)INFINITY : known;
    real room = 1;
    for (int32_t j = 0; j < (int32_t)c->spans; j++) {
        const int32_t h = (int32_t)c->horizon[j];
        const int32_t before = i >= h ? i - h : i - h + N + 1; /* where the last h samples begin */
        const int32_t kept = i + h <= N ? i + h : i + h - N - 1; /* where the last N - h begin */
        const real recent = c->arrived + r.in[before];
        c->held[j] = larger(anc_limiter_floor, larger(recent, c->held[j] * c->fade));
        const real steady = smaller((real)h * c->loud, c->held[j]);
        const real coming = smaller(most - (c->arrived + r.in[kept]), steady);
        const real left = smaller(c->room[j], 1 - (c->spent + r.out[kept]));
        room = smaller(left / larger(anc_limiter_floor, coming), room);
    }
    return root(larger(0, room));
}

/* Start a new lap; the one just completed becomes the last one. */
static void start_lap(anc_limiter *c, rows r, int32_t N)
{
    real rest = 0;
    for (int32_t k = N - 1; k > 0; k--) {
        rest += r.square[k]; /* a sum without differences: the guarantee depends on it */
        r.out[k] = rest;
        r.in[k] = c->arrived + r.in[k - 1];
    }
    c->position = 0;
    c->spent = 0;
    c->arrived = 0;
    c->known = c->held[(int32_t)c->spans - 1];
}

static real square_of(const anc_limiter *c, real y) { return (y * c->scale) * (y * c->scale); }

/* Take an input's energy, and set the gain. */
static void hear(anc_limiter *c, rows r, int32_t i, int32_t N, real u)
{
    const real energy = square_of(c, smaller(c->planned, u < 0 ? -u : u));
    c->arrived += energy;
    r.in[i] = -c->arrived;
    c->average = larger(anc_limiter_floor, c->average + c->attack * (energy - c->average));
    c->loud = larger(c->average, c->loud * c->calm);
    const real wanted = aim(c, r, i, N);
    const real rise = c->release * larger(0, OVERSHOOT * wanted - c->gain);
    c->gain = smaller(c->gain + rise, wanted);
}

/* Return the output: what is wanted, within the amplitude limit, and with no more than the energy
 * that is left. This is the guarantee; the gain makes a clip rare. */
static real fit(anc_limiter *c, real wanted, real u, real left)
{
    real y = smaller(c->limit, larger(-c->limit, wanted));
    if (square_of(c, y) > left) {
        const real rest = root(larger(0, left)), most = c->peak * rest;
        y = u < 0 ? -most : most;
    }
    if (y != wanted) c->clipped += 1;
    return y;
}

/* Take an output's energy, and go on to the next position. */
static void record(anc_limiter *c, rows r, int32_t i, int32_t N, real square)
{
    c->spent += square;
    r.out[i] = -c->spent;
    r.square[i] = square;
    if (i + 1 < N)
        c->position = (real)(i + 1);
    else
        start_lap(c, r, N);
}

/* Return the output at position i of a lap. */
static real restrain(anc_limiter *c, rows r, int32_t i, int32_t N, real u)
{
    hear(c, r, i, N, u);
    const real wanted = c->gain * u;
    const real left = c->budget - (c->spent + r.out[i + 1]);
    const real y = fit(c, wanted, u, left);
    record(c, r, i, N, square_of(c, y));
    return y;
}

real anc_limit(anc_limiter *c, real *laps, real u)
{
    const int32_t N = (int32_t)c->size;
    const rows r = {laps, laps + N + 1, laps + 2 * ((size_t)N + 1)};
    return isfinite(u) ? restrain(c, r, (int32_t)c->position, N, u) : (real)NAN;
}

void anc_limit_all(anc_limiter *c, real *laps, const real *input, real *output, int64_t n)
{
    for (int64_t t = 0; t < n; t++) output[t] = anc_limit(c, laps, input[t]);
}
