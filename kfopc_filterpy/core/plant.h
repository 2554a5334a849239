/* The Gaussian posterior of the paths theta = [p, s], of every microphone: e = p * x - s * y and noise. All microphones
 * hear the same z = [x, -y], so one matrix G = sum z z' serves them all. Exact secondary paths are no part of theta.
 *
 * Histories hold the newest sample first. So the sums of a block are correlations, see `correlate`. */
#ifndef PLANT_H
#define PLANT_H
#include "signals.h"

enum { DRAWS = PARTS, PLANT_ROWS = 6 }; /* draws of the posterior, side by side in a vector; rows of `work` */

typedef struct {
    real samples, fitted;      /* that the data stand for, and those of the last fit; both fade */
    real spread, prior;        /* rms error of s^ over the path; precision of a tap of p, 0: not known yet */
    real misfit, seen;         /* mean of (unexplained / d^2)^2, and its weight */
    real limit, before;        /* at the last alarm: the limit that was exceeded; the noise before it */
    real set_aside;            /* samples of the pending factorisation */
} plant_numbers;

enum { AGE, IDLE, SOUNDS, DOUBTFUL, STALE, RANDOM, PENDING, GROUPS, WRONG, PLANT_COUNTS };
/* AGE: blocks since the loudspeakers sound, or since an alarm; IDLE: since the last fit began; DOUBTFUL: no fit since the
 * alarm; STALE: the correlations are not those of the posterior; PENDING: 1 + blocks until the fit ends, 0: none; GROUPS:
 * those of its rows that are factorised; WRONG: blocks since the alarm that exceed its limit. */
enum { FILLED, MISSING, HEARD, AWAITED, BLOCK_COUNTS };
/* FILLED, MISSING: samples of this block, and whether an error of it is; HEARD: samples of all blocks; AWAITED: the error of
 * the last control signal is still to come. */

typedef struct {
    int32_t K, J, I, N, M, B, n, padded, history, exact, delay, width; /* delay: blocks that a factorisation takes */
    const real *path;        /* s^, (K, J, M) */
    plant_numbers *numbers;
    int32_t *counts, *fits, *alarms, *heard; /* heard: BLOCK_COUNTS */
    real *z, *errors;        /* (I + J, history) x and y, (K, B) of this block, newest first */
    real *theta, *q;         /* (K, n), (K) mean and noise */
    real *draws;             /* (DRAWS, n) of theta less its mean, for the mean noise */
    real *G, *r, *ee;        /* lower triangle in rows; (K, n) sum e z; (K) sum e^2 */
    real *factor, *inverse;  /* of the data set aside, in panels, and 1 / its diagonal */
    real *set_r, *set_ee;    /* r and ee, set aside with it */
    real *ss, *ps;           /* (J, J, 2M - 1), (I, J, N + M - 1) expected correlations */
    real *sides;             /* (padded, PARTS) right sides of a solution */
    real *work;              /* (PLANT_ROWS, width) */
} plant;

/* Set to_l = sum_k a_k b_(k + l), k < n, l < count. */
void correlate(real *restrict to, const real *restrict a, int32_t n, const real *restrict b, int32_t count);
void layout_posterior(plant *f, const signals *s, int32_t block, int exact, anc_layout *at);
void start_posterior(plant *f, real spread);
static inline real *history_of(const plant *f, int32_t signal) { return f->z + times(signal, f->history); } /* x, then y */
/* Return where the newest sample of x or y belongs. */
static inline real *place_of(const plant *f, int32_t signal) { return history_of(f, signal) + (f->B - 1 - f->heard[FILLED]); }
/* Take the errors of the newest samples; NULL if they were not heard. Return whether the block is complete. */
int complete_sample(plant *f, const real *error);
/* Learn from a complete block, whose errors are overwritten. `forget` is the factor by which the data fade in a block. */
void learn(plant *f, real forget);
void begin_block(plant *f);
/* Set ss and ps to those of the posterior, summed over microphones: with a ~ b for sum_m a(m + u) b(m), ss_ja is
 * E[s_j ~ s_a](u) with u from 1 - M up, and ps_ij is E[p_i ~ s_j] from N - 1 down, as it is convolved. */
void expect(plant *f);

static inline void add_to(real *restrict to, const real *restrict from, int32_t n)
{
    for (int32_t i = 0; i < n; i++) to[i] += from[i];
}

/* Let sums fade and add new ones. What is nearly zero is zero: in a long silence, numbers that fade would become so small
 * that processors compute slowly. */
#ifdef ANC_FLOAT
static const real NEARLY_ZERO = 1e-30f;
#else
static const real NEARLY_ZERO = 1e-290;
#endif
static inline real faded(real sum, real forget, real more)
{
    const real next = forget * sum + more;
    return next < NEARLY_ZERO && next > -NEARLY_ZERO ? 0 : next;
}

/* No sample that is learned from is louder than this, whether x, e or what is played, so no sum of products overflows. */
#ifdef ANC_FLOAT
static const real LOUDEST_LEARNT = 1e6f, LOUDEST_PLAYED = 1e12f;
#else
static const real LOUDEST_LEARNT = 1e20, LOUDEST_PLAYED = 1e100;
#endif

static inline int is_too_loud(const signals *s, const real *reference)
{
    for (int32_t i = 0; i < s->I; i++)
        if (!within(reference[i], LOUDEST_LEARNT) || !within(reference[i], *s->loudest)) return 1;
    return 0;
}

static inline real raised(real g, int32_t n) /* g^n */
{
    real power = 1;
    for (; n; n /= 2, g *= g)
        if (n % 2) power *= g;
    return power;
}
static inline void count_up(int32_t *count) { *count += *count < 1 << 30; }
#endif
