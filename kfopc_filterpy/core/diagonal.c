/* The Kalman filter with only the diagonal p of its covariance, in O(L) per sample: eq. 2-9 for the
 * weights of all loudspeakers, which the microphones measure one after the other. */
#include "signals.h"

typedef struct {
    signals s;
    real *variances; /* (J, I, L) p */
    real *direction; /* (J, I, L) P x' = p x', of the last measurement */
} diagonal;

enum { STATE_NOISE, MEASUREMENT_NOISE, INITIAL_VARIANCE };
static const anc_setting diagonal_settings[] = {{"state_noise", 0, MOST_VARIANCE, ANC_ONE},
                                                {"measurement_noise", 0, MOST_VARIANCE, ANC_ONE},
                                                {"initial_variance", 0, MOST_VARIANCE, ANC_ONE},
                                                {0}};

static void layout(anc_view *view, const anc_plan *plan, anc_layout *at)
{
    diagonal *f = (diagonal *)view;
    const signals *s = &f->s;
    (void)plan;
    f->variances = reals(at, "variances", ANC_STATE, 1, s->J, s->I, s->L);
    f->direction = reals(at, "direction", ANC_SCRATCH, 1, s->J, s->I, s->L);
}

static void start(anc_view *view)
{
    diagonal *f = (diagonal *)view;
    for (int32_t i = 0; i < states(&f->s); i++) f->variances[i] = *f->s.setting[INITIAL_VARIANCE];
}

/* p += r, then set the direction p x' for the row x' of microphone k; return S = x'^T p x' + q. */
static real look(diagonal *f, const lines *rows, int32_t k, real r)
{
    const signals *s = &f->s;
    const int32_t n = s->J * s->I, L = s->L;
    real S = *s->setting[MEASUREMENT_NOISE];
    for (int32_t ji = 0; ji < n; ji++) {
        const real *restrict x = newest(rows, k * n + ji);
        real *restrict p = f->variances + times(ji, L), *restrict g = f->direction + times(ji, L);
        for (int32_t l = 0; l < L; l++) {
            p[l] += r;
            g[l] = p[l] * x[l];
        }
        S += dot(g, x, L);
    }
    return S;
}

/* Measure d = w'x' + e_o at microphone k, or zero if d is NULL: with K = p x' / S,
 * w += K (d - w'x') and p -= K x' p. */
static void measure(diagonal *f, const lines *rows, int32_t k, const real *d, real r)
{
    const signals *s = &f->s;
    const int32_t n = s->J * s->I, L = s->L;
    const real inverse = 1 / look(f, rows, k, r),
               size = root(dot(f->direction, f->direction, n * L));
    /* Without measurement noise, a reference that is almost silent carries no information. */
    if (!within(inverse * size, anc_longest_step)) return;
    for (int32_t scenario = 0; scenario < s->S; scenario++) {
        real *w = weights_of(s, scenario * s->J);
        const real z = d ? d[scenario * s->K + k] : 0;
        const real step = inverse * (z - heard_output(s, rows, scenario, k));
        if (within(step * size, anc_longest_step)) add_scaled(w, step, f->direction, n * L);
    }
    for (int32_t ji = 0; ji < n; ji++) {
        const real *restrict x = newest(rows, k * n + ji), *restrict g =
                                                               f->direction + times(ji, L);
        real *restrict p = f->variances + times(ji, L);
        for (int32_t l = 0; l < L; l++) {
            const real left = 1 - inverse * g[l] * x[l];
            p[l] *= left > 0 ? left : 0; /* rounding of S can make it negative */
        }
    }
}

static int update(anc_view *view, const real *error)
{
    diagonal *f = (diagonal *)view;
    signals *s = &f->s;
    const int refused = error ? estimate(s, error) : ANC_DONE;
    if (!error || refused) return refused;
    for (int32_t sk = 0; sk < s->S * s->K; sk++)
        s->estimate[sk] *= least_factor(s, sk / s->K); /* eq. 9 */
    commit(s);
    for (int32_t k = 0; k < s->K; k++)
        measure(f, &s->filtered, k, s->estimate, k == 0 ? *s->setting[STATE_NOISE] : 0);
    for (int32_t k = 0; s->G && k < s->K; k++)
        measure(f, &s->guarded, k, NULL, 0); /* as if w'x'' had been measured as zero */
    return ANC_DONE;
}

const anc_algorithm anc_diagonal = {.name = "diagonal KF",
                                    .settings = diagonal_settings,
                                    .layout = layout,
                                    .start = start,
                                    .control_signal = filtered_signal,
                                    .update = update};
