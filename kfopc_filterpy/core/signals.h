/* The signals of a filtered-reference controller: x, x' = s^ * x, y, d^ = e + s^ * y, and the powers of eq. 10-13. */
#ifndef SIGNALS_H
#define SIGNALS_H
#include "vectors.h"

/* No signal may be louder than LOUDEST, no reference than LOUDEST_REFERENCE, and no step of the weights longer than LARGEST.
 * So no square overflows, and no weight or control signal can within 10^40 samples (10^5 in float). What exceeds these
 * limits is refused before anything changes. Up to CALM, a factor of the reference in a step is not looked at: CALM times
 * LOUDEST_REFERENCE is no long step. */
#ifdef ANC_FLOAT
static const real LOUDEST = 1e12f, LOUDEST_REFERENCE = 1e6f, LARGEST = 1e6f, CALM = 1;
#else
static const real LOUDEST = 1e100, LOUDEST_REFERENCE = 1e25, LARGEST = 1e50, CALM = 1e20;
#endif

/* The largest variance that a setting may have: neither it nor its sum over all samples overflows. */
#ifdef ANC_FLOAT
#define MOST_VARIANCE 1e25f
#else
#define MOST_VARIANCE 1e50
#endif

enum { ANC_MOST_SETTINGS = 8, ANC_GUARD_TAPS = 48 };

typedef struct { /* delay lines that advance together */
    real *room;  /* (rows, length) */
    int32_t *at; /* where the newest samples are */
    int32_t rows, taps, length;
} lines;

typedef struct {
    int32_t S, K, J, I, L, M, G;
    int32_t limited, power_length, limiter_length; /* the longest windows: rows of `power_window` and `laps` */
    int32_t *power_windows;                        /* (S, J) */
    real *path, *guard;                            /* s^, (K, J, M), and W, (G) */
    real *loudest;                                 /* |x| beyond it is refused */
    real *setting[ANC_MOST_SETTINGS];              /* the algorithm's own: one number each, (J) or (K) */
    lines x, filtered, y, guarded;                 /* rows (I), (K, J, I), (S, J), (K, J, I); y after limiter and amplifier model */
    anc_amplifier *amplifier;                      /* (S, J) known models; linear: d^ = e + s^ * y as published */
    anc_limiter *limiter;                          /* (S, J) if limited */
    real *laps;                                    /* (S, J, 3, limiter_length + 1) */
    anc_constraint *constraint;                    /* (S, J) */
    anc_power *powers;                             /* (S, J, ANC_POWERS) */
    real *power_window;                            /* (S, J, ANC_POWERS, power_length) */
    real *weights;                                 /* (S, J, I, L) */
    real *control;                                 /* (S, J) the last y */
    anc_previewed *previewed;                      /* (S, J) */
    real *estimate, *heard;                        /* (S, K) d^, and sum_ji w_ji' x'_kji */
    real *squares;                                 /* (S, J, ANC_POWERS) of d^, x'_j and x, previewed */
    real *step;                                    /* (S, J, STEPS) */
} signals;

enum { KEEP, MU, PENALTY, STEPS }; /* of one loudspeaker's step: w = keep w + mu sum_k e_k x'_k - penalty x */

static inline size_t times(int32_t a, int32_t b) { return (size_t)a * (size_t)b; }
static inline real *newest(const lines *l, int32_t row) { return l->room + times(row, l->length) + *l->at; }
static inline int32_t states(const signals *s) { return s->J * s->I * s->L; }
static inline int within(real value, real most) { return value <= most && value >= -most; } /* not NaN either */
static inline real *weights_of(const signals *s, int32_t sj) { return s->weights + times(sj, s->I * s->L); }

/* Layout. */
#define COLUMNS(type) (int32_t)(sizeof(type) / sizeof(real))
real *reals(anc_layout *at, const char *name, anc_role role, int32_t n0, int32_t n1, int32_t n2, int32_t n3);
int32_t *int32s(anc_layout *at, const char *name, anc_role role, int32_t n);
int32_t numbers_of(const anc_setting *setting, const anc_plan *plan); /* how many a setting has */
void layout_signals(signals *s, const anc_plan *plan, const anc_setting *settings, anc_layout *at);
void layout_unfiltered(signals *s, const anc_plan *plan, const anc_setting *settings, anc_layout *at); /* without x' */
void start_signals(signals *s, const anc_plan *plan, const anc_setting *settings);

/* The same as functions of an algorithm, and the usual control signal: the weights' output. */
void layout_plain(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at);
void start_plain(anc_view *view, const anc_plan *plan, const anc_setting *settings);
int filtered_signal(anc_view *view, const real *reference, real *control);

/* The parts of a sample, in this order; `sj` is a loudspeaker of a scenario. Those that return int return ANC_DONE, or
 * why they refused, with nothing changed. */
int take_reference(signals *s, const real *reference);
real filter_output(const signals *s, int32_t sj);  /* sum_i w_ji' x_i */
void emit(signals *s, int32_t sj, real y);         /* through limiter and amplifier model, into the delay line of y */
int estimate(signals *s, const real *error);       /* d^, with the powers and factors previewed */
int estimate_disturbance(signals *s, const real *error); /* the first half of `estimate`: d^ and the squares */
void preview(signals *s);                          /* the second half: the powers and factors of these squares */
real least_factor(const signals *s, int32_t scenario); /* of its loudspeakers that a microphone hears, previewed */
void commit(signals *s);                           /* take the previewed powers */
real heard_output(const signals *s, const lines *rows, int32_t scenario, int32_t k); /* sum_ji w_ji' x'_kji, or with the guarded rows */
real energy_of(const signals *s, const lines *rows, int32_t first, int32_t count); /* of the L newest samples of rows */
void set_step(signals *s, int32_t sj, real keep, real mu, real penalty);
int descend(signals *s, const real *error);        /* the steps of all loudspeakers; commits */
#endif
