/* The covariance of n weights in a random walk (eq. 4-8). */
#ifndef COVARIANCE_H
#define COVARIANCE_H
#include "signals.h"

/* P = scale (T - pending u u') + diagonal I, with u = P x' / sqrt(S) of the last update. What is pending is applied in
 * the pass that computes the next P x', so each element is read and written once a sample. T is the lower triangle, one
 * row after the other, in groups of PARTS rows. All rows of a group end with its last column: row i has the elements 0
 * to PARTS (i / PARTS + 1) - 1. So the square at the end of a group has both halves, which stay equal, and a pass works
 * on whole vectors only. Elements beyond n are zero. */
typedef struct {
    int32_t n, padded; /* n in whole groups */
    anc_owed *owed;
    real *T, *u;
    real *h, *Ph;      /* (padded) the row x' of the present pass, and P x' */
    real *careful;     /* (CAREFUL, padded) room for numbers in twice the precision */
} covariance;

static inline int32_t padded(int32_t n) { return (n + PARTS - 1) / PARTS * PARTS; }
static inline real *row_of(const covariance *c, int32_t i) /* T's */
{
    const int32_t group = i / PARTS;
    return c->T + times(group, group + 1) * (PARTS * PARTS / 2) + times(i % PARTS, group + 1) * PARTS;
}

void layout_covariance(covariance *c, int32_t n, anc_layout *at);
void start_covariance(covariance *c, real initial_variance);
/* Return whether P = fading P + r I and P x' are sure to be finite for rows x' of this energy; nothing is changed. */
int predictable(const covariance *c, real fading, real state_noise, real energy);
/* Eq. 4, still pending: P = fading P + r I. */
void predict(covariance *c, real fading, real state_noise);
/* Apply what is pending, set c->Ph to P c->h, and return h' P h; q is the measurement noise. */
real project(covariance *c, real q);
/* Return whether S is large enough for a gain; otherwise K could exceed LARGEST. Without measurement noise, S is too
 * small for a row that carries no information: one of hardly any energy, or along which P is zero. */
int tells(const covariance *c, real S);
/* Eq. 8, P -= g g' / S with g = P h, after `project`; in twice the precision if S is far above the measurement noise q.
 * Return 1 / sqrt(S). */
real downdate(covariance *c, real S, real q);
/* Eq. 5, w += K y with K = u / sqrt(S) (eq. 6). Return 0, with nothing changed, if a weight could move by more than
 * `most`. */
int correct(const covariance *c, real *w, real innovation, real inverse_root, real most);
#endif
