/* Active noise control in C99: no allocation, no input or output, no global state, the same bits on every machine.
 *
 * A controller is a plan (its shape and settings), a block of memory (all that changes) and a view (where its fields
 * are in the block). A copy of the block, opened again, is a copy of the controller: written to a file, it goes on to
 * the bit.
 *
 * S scenarios, K microphones, J loudspeakers, I references, L taps of a control filter, M taps of a secondary path, G
 * taps of a guard. Arrays are row-major in that order, with channels first; delay lines hold the newest sample first.
 * Scenarios have the same references, estimated paths and gains, and each its own weights, powers and plant.
 * Signs: e = d - s*y_amp, d^ = e + s^*y. */
#ifndef ANC_H
#define ANC_H
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
#ifndef ANC_PUBLIC
#if defined _WIN32
#define ANC_PUBLIC __declspec(dllexport)
#elif defined __GNUC__
#define ANC_PUBLIC __attribute__((visibility("default")))
#else
#define ANC_PUBLIC
#endif
#endif

#ifdef ANC_FLOAT
typedef float anc_real;
#else
typedef double anc_real;
#endif

/* Controllers. */

typedef struct {
    int32_t scenarios, microphones, loudspeakers, references, taps, path_taps; /* S, K, J, I, L, M */
    int32_t guard_taps;             /* G; 0: the secondary paths are exact */
    int32_t limited;                /* 1: with limiters, which are silent until the host sets their numbers */
    int32_t modelled;               /* 1: the last K of the references are d^ of the sample before, which the host does not
                                     * give (internal model); one scenario */
    const int32_t *power_windows;   /* (S, J) samples of the window of the powers; 0: exponential. NULL: all 0 */
    const int32_t *limiter_windows; /* (S, J) samples of each limiter's window; NULL without limiters */
    const anc_real *path;           /* (K, J, M) estimated secondary paths */
    const anc_real *guard;          /* (G) filter W; NULL without */
    const anc_real *settings;       /* the algorithm's own in its order: one number each, or as many as `each` says. NULL:
                                     * each at its least, if only the shape of a block is asked for */
} anc_plan;

typedef enum { ANC_ONE, ANC_EACH_LOUDSPEAKER, ANC_EACH_MICROPHONE } anc_each;
typedef struct {
    const char *name;
    anc_real least, most; /* inclusive; most 0: any finite value from least on */
    anc_each each;
} anc_setting;

typedef struct { void *place[128]; } anc_view; /* room for any algorithm's */

typedef enum { ANC_STATE, ANC_SETTING, ANC_SCRATCH } anc_role; /* scratch: nothing that a next sample needs */
typedef enum { ANC_IS_REAL, ANC_IS_INT32 } anc_type;
typedef void anc_visitor(void *to, const char *name, anc_role role, anc_type type, size_t offset, const int32_t shape[4]);

/* A walk over the fields of a block: to measure it, to describe it, or to find them in memory. */
typedef struct {
    char *memory; /* NULL: only measure */
    size_t size;  /* so far; SIZE_MAX: more than a machine can address, or than the algorithm takes */
    anc_visitor *visit;
    void *to;
} anc_layout;

/* What a step returns. A step that is refused changed no state. */
typedef enum { ANC_DONE, ANC_LOUD_REFERENCE, ANC_LOUD_ERROR, ANC_LOUD_ESTIMATE, ANC_LOUD_STEP, ANC_NO_SOLUTION, ANC_LOST_ARRAY } anc_answer;

typedef struct {
    const char *name;
    const anc_setting *settings; /* ends with a NULL name */
    void (*layout)(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at);
    void (*start)(anc_view *view, const anc_plan *plan, const anc_setting *settings);    /* before the first sample, on zeros */
    int (*control_signal)(anc_view *view, const anc_real *reference, anc_real *control); /* (I) -> (S, J) */
    int (*update)(anc_view *view, const anc_real *error); /* (S, K); NULL: a sample that is not adapted to */
    int (*listen)(anc_view *view, const anc_real *error); /* before control is on; NULL: follow the powers */
} anc_algorithm;

extern ANC_PUBLIC const anc_algorithm anc_fxlms, anc_fxnlms, anc_leaky, anc_optimal_leaky, anc_mov, anc_mov_fixed, anc_two_gradient,
    anc_clipping, anc_rescaling, anc_kalman, anc_diagonal, anc_fast_array, anc_finite_memory, anc_repaired,
    anc_power_budget, anc_observer, anc_signals_alone;

/* Bytes of a block; 0 if its shape is refused: a count below 1, or too large. */
ANC_PUBLIC size_t anc_size(const anc_algorithm *algorithm, const anc_plan *plan);
/* Find the fields in a block, which is aligned as anc_real is; start it if it is fresh. Return 0 if the block is too
 * small or the plan is refused: for its shape, or if the block is fresh, for a setting out of its range or a path or
 * guard that is missing or not finite. */
ANC_PUBLIC int anc_open(const anc_algorithm *algorithm, const anc_plan *plan, anc_view *view, void *block, size_t bytes, int fresh);
ANC_PUBLIC void anc_describe(const anc_algorithm *algorithm, const anc_plan *plan, anc_visitor *visit, void *to);
/* Filter the stored references again, after the paths or the guard in the block have changed. */
ANC_PUBLIC void anc_refilter(anc_view *view);
/* Take an error that is not adapted to: an internal model needs it for its next reference. `update` takes its own. */
ANC_PUBLIC int anc_take_error(anc_view *view, const anc_real *error);
/* Follow x, (n, I), and e, (n, S, K), while the loudspeakers are silent: the delay lines advance, and so do the powers
 * where `adapt` is 1; the weights stay, unless the algorithm has a `listen` of its own. Return the number of samples
 * before a refused one, and set `answer` to its answer. */
ANC_PUBLIC int64_t anc_listen(const anc_algorithm *algorithm, anc_view *view, const anc_real *x, const anc_real *e, const uint8_t *adapt, int64_t n, int32_t *answer);

/* Parts that also work alone. */

typedef enum { ANC_LINEAR, ANC_HARD_CLIP, ANC_SOFT_SATURATION } anc_amplifier_kind;
typedef struct { anc_real kind, limit, sharpness; } anc_amplifier;
ANC_PUBLIC anc_real anc_amplify(const anc_amplifier *amplifier, anc_real y);
ANC_PUBLIC void anc_amplify_all(const anc_amplifier *amplifier, const anc_real *input, anc_real *output, int64_t n);

/* Eq. 10-13 for one loudspeaker. */
typedef struct { anc_real mean_square, lap, taken, position; } anc_power;
typedef struct {
    anc_real rated_power, rate;                              /* rho_o; the least share of a new square */
    anc_real supplied_factor, supplied_power, supplied_gain; /* NaN: computed */
    anc_real factor, power, gain;                            /* those used last */
} anc_constraint;
enum { ANC_DISTURBANCE, ANC_FILTERED, ANC_REFERENCE, ANC_POWERS };
typedef struct { anc_real factor, power, gain, mean[ANC_POWERS]; } anc_previewed; /* with the present sample in them */
/* Preview a sample, given by its squares (that of the reference NaN: none was given). */
ANC_PUBLIC void anc_preview(const anc_constraint *c, const anc_power *powers, const anc_real *window, int32_t length, anc_previewed *next, anc_real d2, anc_real f2, anc_real x2);
/* Take a sample that was previewed. */
ANC_PUBLIC void anc_commit(anc_constraint *c, anc_power *powers, anc_real *window, int32_t length, const anc_previewed *next, anc_real d2, anc_real f2, anc_real x2);

enum { ANC_HORIZONS = 16 };
typedef struct {
    anc_real scale, peak, budget, limit, planned, attack, calm, fade, release; /* settings */
    anc_real size, spans, position;                                            /* samples of a window; horizons used; of the lap */
    anc_real spent, arrived, average, loud, known, gain, clipped;
    anc_real horizon[ANC_HORIZONS], held[ANC_HORIZONS], room[ANC_HORIZONS];
} anc_limiter;
/* Return the output for the next input; `laps` has 3 rows of size + 1. */
ANC_PUBLIC anc_real anc_limit(anc_limiter *limiter, anc_real *laps, anc_real u);
ANC_PUBLIC void anc_limit_all(anc_limiter *limiter, anc_real *laps, const anc_real *input, anc_real *output, int64_t n);

/* The covariance of n weights in a random walk, in memory of the host, which sets T and the numbers owed (see
 * covariance.h). */
typedef struct {
    anc_real scale, diagonal, pending, largest, bound, floored; /* largest: at the start; bound: of all now */
    anc_real usual;                                             /* variance along the rows */
} anc_owed;
ANC_PUBLIC size_t anc_covariance_size(int32_t n);
ANC_PUBLIC void anc_covariance_describe(int32_t n, anc_visitor *visit, void *to);
/* Eq. 5-9 for a row h: correct w by the measurement z with noise q. `result` gets the innovation and S. */
ANC_PUBLIC int anc_covariance_update(void *memory, int32_t n, anc_real *w, const anc_real *h, anc_real z, anc_real q, anc_real result[2]);
/* Eq. 4: P = fading P + r I; see `predict` in covariance.h. */
ANC_PUBLIC void anc_covariance_predict(void *memory, int32_t n, anc_real r, anc_real fading);
/* Both: a row that carries no information, S = 0, corrects nothing. */
ANC_PUBLIC int anc_covariance_step(void *memory, int32_t n, anc_real *w, const anc_real *h, anc_real z, anc_real r, anc_real q, anc_real fading, anc_real result[2]);

/* The loop. */

typedef struct { /* a controller as the loop sees it: of the core or of the host */
    void *self;
    int (*control_signal)(void *self, const anc_real *reference, anc_real *control);
    int (*update)(void *self, const anc_real *error);
    int (*take_error)(void *self, const anc_real *error); /* one that is not adapted to; NULL: it is not needed */
} anc_controller;

typedef struct {
    int32_t scenarios, microphones, loudspeakers, references, path_taps, feedback_taps; /* one scenario if feedback */
    int32_t at, length;              /* of the delay lines of y_amp, at least as long as both paths */
    const anc_real *path, *feedback; /* (S, K, J, path_taps) true s; (I, J, feedback_taps) to references */
    const anc_amplifier *amplifiers; /* (S, J) */
    anc_real *output;                /* (S, J, length) */
    anc_real *reference, *control, *error; /* (I), (S, J), (S, K): the present sample */
    const anc_real *limit;           /* (S, J) a control signal beyond it is a divergence */
} anc_plant;

typedef struct { /* numbers to record: number c of sample n goes to to[n / every * row + c * column] */
    const anc_real *from;
    int64_t step, count, every, row, column;
    anc_real *to;
} anc_record;

typedef struct { /* (channels, length) each; those of scenarios one after the other */
    int64_t length;
    const anc_real *reference, *disturbance, *sensor_noise; /* the last may be NULL, or `error`, which overwrites it */
    anc_real *error, *control_signal, *amplifier_output, *anti_noise;
} anc_signals;

typedef enum { ANC_RUNNING, ANC_DIVERGED, ANC_REFUSED_REFERENCE, ANC_REFUSED_ERROR } anc_status;

/* Run a controller and a plant from sample `begin` to `end`; return the first sample that was not completed. With a
 * status of ANC_DIVERGED, go on from the divergence at `begin`: the control signals of that sample are those in
 * `plant`. */
ANC_PUBLIC int64_t anc_run(const anc_controller *controller, anc_plant *plant, const anc_signals *signals, const anc_record *records, int32_t n_records, int64_t begin, int64_t end, int32_t *status);
/* The plant's two halves of a sample, for a controller that the host calls. */
ANC_PUBLIC void anc_hear(anc_plant *plant, const anc_signals *signals, int64_t n);
ANC_PUBLIC void anc_play(anc_plant *plant, const anc_real *amplified, const anc_signals *signals, int64_t n);
/* Process a block, (channels, length) each, from sample `begin` to `end`; return the first sample that was refused, or
 * `end`. */
ANC_PUBLIC int64_t anc_process(const anc_controller *controller, int32_t references, int32_t loudspeakers, int32_t microphones, const anc_real *x, const anc_real *e, anc_real *y, const uint8_t *adapt, int64_t length, int64_t begin, int64_t end, anc_real *scratch, int32_t *status);

#ifdef __cplusplus
}
#endif
#endif
