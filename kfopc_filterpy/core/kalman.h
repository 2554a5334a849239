/* A Kalman filter of all weights: microphones are measured one after the other, since their noises are independent. */
#ifndef KALMAN_H
#define KALMAN_H
#include "covariance.h"

typedef struct {
    signals s;
    covariance c;
    real *scaled; /* (S, K) alpha d^, the measurements; after the update the innovations, over sqrt(S) */
    real *trim;   /* (S, J, TRIMS) of repaired.c only */
} kalman;

enum { TRIM, OUTPUT_GAIN, TRIMS };
enum { STATE_NOISE, MEASUREMENT_NOISE, INITIAL_VARIANCE, FADING, KALMAN_SETTINGS };
#define KALMAN_SETTINGS_LISTED                                                                                          \
    {"state_noise", 0, 0, ANC_ONE}, {"measurement_noise", 0, 0, ANC_EACH_MICROPHONE}, {"initial_variance", 0, 0, ANC_ONE}, \
    {"fading", 1, 1e30f, ANC_ONE}

void layout_kalman(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at);
void start_kalman(anc_view *view, const anc_plan *plan, const anc_setting *settings);
/* Eq. 2-9 with the measurements in `scaled`, after `estimate`; commits. */
int correct_weights(kalman *f);
#endif
