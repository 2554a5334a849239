/* The core's control loop for a page: one reference, loudspeaker and microphone, blocks of samples, an amplifier that clips.
 *
 * The page writes paths, settings and noise into buffers, opens a controller, and then asks for blocks. It does the same as
 * a native library, so that a test can compare the bits. */
#include "signals.h"
#include <string.h>

#ifdef __wasm__
#define EXPORTED(name) __attribute__((export_name(#name))) name
#else
#define EXPORTED(name) name
#endif

enum { MOST_TAPS = 8192, BLOCK = 128, LINE = 4 * MOST_TAPS, ROOM = 24 << 20 };
enum { OFF, FXNLMS, KALMAN, CONSTRAINED_KALMAN, POWER_BUDGET };                          /* controllers */
enum { PRIMARY, SECONDARY, SETTINGS, NOISE, ERROR, DISTURBANCE, BUFFERS };               /* buffers */
enum { SUM_OF_DISTURBANCE, SUM_OF_ERROR, SUM_OF_CONTROL, FACTOR, STATUS, NUMBERS };      /* numbers */

static real primary[MOST_TAPS], secondary[MOST_TAPS], settings[ANC_MOST_SETTINGS];
static real noise[BLOCK], error[BLOCK], disturbance[BLOCK];
static real heard[LINE], played[LINE];
static int32_t heard_at, primary_taps;
static real sums[NUMBERS];
static _Alignas(64) char block[ROOM];
static anc_view view;
static anc_plant plant;
static anc_amplifier amplifier;
static real reference, control, microphone, limit;
static anc_controller controller;
static int chosen;

static int silent(void *self, const real *x, real *y) { return (void)self, (void)x, *y = 0, ANC_DONE; }
static int deaf(void *self, const real *e) { return (void)self, (void)e, ANC_DONE; }

static const anc_algorithm *algorithm_of(int which)
{
    return which == FXNLMS ? &anc_fxnlms : which == POWER_BUDGET ? &anc_power_budget : &anc_kalman;
}

real *EXPORTED(player_buffer)(int which)
{
    real *const buffers[BUFFERS] = {primary, secondary, settings, noise, error, disturbance};
    return buffers[which];
}

real EXPORTED(player_number)(int which) { return sums[which]; }

/* The amplifier clips at twice the root of the rated power. A controller that knows the rating keeps it. */
void EXPORTED(player_rate)(real rated)
{
    amplifier = (anc_amplifier){ANC_HARD_CLIP, 2 * root(rated), 1};
    if (chosen == CONSTRAINED_KALMAN) ((signals *)&view)->constraint->rated_power = rated;
    if (chosen == POWER_BUDGET) *((signals *)&view)->setting[0] = rated;
}

/* Open a controller on the buffers' paths and settings, with `rate` the least share of a new square in the powers of
 * eq. 10-11; return 0 if it is refused. The delay lines of the plant go on if `afresh` is 0. */
int EXPORTED(player_open)(int which, int taps, int n_primary, int n_secondary, real rated, real rate, int afresh)
{
    if (n_primary > MOST_TAPS || n_secondary > MOST_TAPS || taps > MOST_TAPS) return 0;
    const anc_plan plan = {.scenarios = 1, .microphones = 1, .loudspeakers = 1, .references = 1, .taps = taps,
                           .path_taps = n_secondary, .path = secondary, .settings = settings};
    chosen = which;
    controller = (anc_controller){NULL, silent, deaf, NULL};
    if (which != OFF) {
        const anc_algorithm *algorithm = algorithm_of(which);
        const size_t bytes = anc_size(algorithm, &plan);
        if (!bytes || bytes > ROOM) return 0;
        memset(block, 0, bytes);
        if (!anc_open(algorithm, &plan, &view, block, bytes, 1)) return 0;
        if (which == CONSTRAINED_KALMAN)
            *((signals *)&view)->constraint = (anc_constraint){.rated_power = rated, .rate = rate, .supplied_factor = (real)NAN,
                .supplied_power = (real)NAN, .supplied_gain = (real)NAN, .factor = 1, .gain = (real)NAN};
        controller = (anc_controller){&view, (int (*)(void *, const real *, real *))(void *)algorithm->control_signal,
                                      (int (*)(void *, const real *))(void *)algorithm->update, NULL};
    }
    if (afresh || plant.path_taps != n_secondary || primary_taps != n_primary) {
        memset(heard, 0, sizeof heard), memset(played, 0, sizeof played);
        primary_taps = n_primary, heard_at = LINE - n_primary;
        plant = (anc_plant){1, 1, 1, 1, n_secondary, 0, LINE - n_secondary, LINE, secondary, NULL, &amplifier, played, &reference, &control, &microphone, &limit};
    }
    limit = (real)1e6;
    memset(sums, 0, sizeof sums);
    player_rate(rated);
    return 1;
}

static real disturbance_of(real x)
{
    const int32_t before = heard_at;
    if (--heard_at < 0) {
        heard_at = LINE - primary_taps;
        memcpy(heard + heard_at + 1, heard + before, sizeof(real) * (size_t)(primary_taps - 1));
    }
    heard[heard_at] = x;
    return dot(primary, heard + heard_at, primary_taps);
}

/* Run the next samples of the buffer NOISE, and set ERROR. A sample that the controller refuses is played as it is, and a
 * controller that asks for too much is switched off: STATUS then says why. */
void EXPORTED(player_run)(int n)
{
    static real y[BLOCK], amplified[BLOCK], a[BLOCK];
    const anc_signals s = {n, noise, disturbance, NULL, error, y, amplified, a};
    for (int k = 0; k < n; k++) disturbance[k] = disturbance_of(noise[k]);
    int32_t status = ANC_RUNNING;
    for (int64_t k = 0; k < n;) {
        k = anc_run(&controller, &plant, &s, NULL, 0, k, n, &status);
        if (k < n) {
            sums[STATUS] = (real)status;
            controller = (anc_controller){NULL, silent, deaf, NULL};
            k += status == ANC_REFUSED_ERROR; /* it was played */
            status = ANC_RUNNING;
        }
    }
    for (int k = 0; k < n; k++) {
        sums[SUM_OF_DISTURBANCE] += disturbance[k] * disturbance[k];
        sums[SUM_OF_ERROR] += error[k] * error[k];
        sums[SUM_OF_CONTROL] += y[k] * y[k];
    }
    sums[FACTOR] = chosen == CONSTRAINED_KALMAN ? ((signals *)&view)->constraint->factor : 1;
}

/* Start the sums anew. */
void EXPORTED(player_forget)(void) { memset(sums, 0, sizeof(real) * STATUS); }
