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
    real set_aside;            /* samples of the pending factorisation */
} plant_numbers;

enum { AGE, IDLE, SOUNDS, DOUBTFUL, STALE, RANDOM, PENDING, GROUPS, PLANT_COUNTS };
/* AGE: blocks since the loudspeakers sound, or since an alarm; IDLE: since the last fit began; DOUBTFUL: no fit since the
 * alarm; STALE: the correlations are not those of the posterior; PENDING: 1 + blocks until the fit ends, 0: none; GROUPS:
 * those of its rows that are factorised. */

typedef struct {
    int32_t K, J, I, N, M, B, n, padded, history, exact, delay, width; /* delay: blocks that a factorisation takes */
    const real *path;        /* s^, (K, J, M) */
    plant_numbers *numbers;
    int32_t *counts, *fits, *alarms;
    real *theta, *q;         /* (K, n), (K) mean and noise */
    real *draws;             /* (DRAWS, n) of theta less its mean, for the mean noise */
    real *G, *r, *ee;        /* lower triangle in rows; (K, n) sum e z; (K) sum e^2 */
    real *factor, *inverse;  /* of the data set aside, in panels, and 1 / its diagonal */
    real *set_r, *set_ee;    /* r and ee, set aside with it */
    real *ss, *ps, *pp;      /* (J, J, 2M - 1), (I, J, N + M - 1), (I, I, 2N - 1) expected correlations */
    real *sides;             /* (padded, PARTS) right sides of a solution */
    real *work;              /* (PLANT_ROWS, width) */
} plant;

/* Set to_l = sum_k a_k b_(k + l), k < n, l < count. */
void correlate(real *restrict to, const real *restrict a, int32_t n, const real *restrict b, int32_t count);
void layout_posterior(plant *f, const signals *s, int32_t block, int exact, anc_layout *at);
void start_posterior(plant *f, real spread);
/* Take a block: x, (I, history), and y, (J, history), of which it is the newest part, and its errors, (K, B), which are
 * overwritten. `known`: there was enough to learn from that an alarm is possible. */
void learn(plant *f, const real *x, const real *y, real *e, real forget, int known);
/* Set ss, ps and pp to those of the posterior, summed over microphones: with a ~ b for sum_m a(m + u) b(m),
 * ss_ja is E[s_j ~ s_a](u) with u from 1 - M up, pp_ia is p_i ~ p_a from 1 - N up, and ps_ij is E[p_i ~ s_j] from N - 1
 * down, as it is convolved. */
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

static inline real larger(real a, real b) { return a > b ? a : b; }
static inline void count_up(int32_t *count) { *count += *count < 1 << 30; }
#endif
