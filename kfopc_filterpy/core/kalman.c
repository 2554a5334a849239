/* KF-ANC and KF-OPC: eq. 2-9 of Ji et al. with the factor of eq. 10-13, and FxRLS, which is the
 * same with a fading memory. */
#include "covariance.h"

typedef struct {
    signals s;
    covariance c;
    real *scaled; /* (S, K) alpha d^, the measurements */
} kalman;

enum { STATE_NOISE, MEASUREMENT_NOISE, INITIAL_VARIANCE, FADING };
static const anc_setting kalman_settings[] = {{"state_noise", 0, 0, ANC_ONE},
                                              {"measurement_noise", 0, 0, ANC_EACH_MICROPHONE},
                                              {"initial_variance", 0, 0, ANC_ONE},
                                              {"fading", 1, 1e30f, ANC_ONE},
                                              {0}};

static void layout_kalman(anc_view *view, const anc_plan *plan, anc_layout *at)
{
    kalman *f = (kalman *)view;
    (void)plan;
    layout_covariance(&f->c, states(&f->s), at);
    f->scaled = reals(at, "measurement", ANC_SCRATCH, 1, 1, f->s.S, f->s.K);
}

static void start_kalman(anc_view *view)
{
    kalman *f = (kalman *)view;
    start_covariance(&f->c, *f->s.setting[INITIAL_VARIANCE]);
}

/* Set h to the filtered references of microphone k, those of all control filters one after the
 * other. */
static void observe(kalman *f, const lines *rows, int32_t k)
{
    const int32_t n = f->s.J * f->s.I, L = f->s.L;
    for (int32_t ji = 0; ji < n; ji++)
        copy(f->c.h + times(ji, L), newest(rows, k * n + ji), (size_t)L);
}

/* Measure z at microphone k, or zero if z is NULL: eq. 5-9 for every scenario, with one gain. */
static void measure(kalman *f, const lines *rows, int32_t k, const real *z)
{
    const int32_t K = f->s.K;
    const real q = f->s.setting[MEASUREMENT_NOISE][k];
    observe(f, rows, k);
    const real S = project(&f->c, q) + q; /* eq. 7 */
    const int tell = tells(&f->c, S);
    const real inverse_root = tell ? downdate(&f->c, S) : 0;
    for (int32_t scenario = 0; scenario < f->s.S; scenario++) {
        real *w = weights_of(&f->s, scenario * f->s.J);
        const real measured = z ? z[scenario * K + k] : 0;
        const real y = measured - dot(f->c.h, w, f->c.n);
        if (tell) correct(&f->c, w, y, inverse_root);
    }
}

/* Return whether P can be predicted, and all rows be measured, without overflow. */
static int solvable(const kalman *f, real fading, real r)
{
    const signals *s = &f->s;
    const int32_t n = s->J * s->I;
    for (int32_t k = 0; k < s->K; k++) {
        if (!predictable(&f->c, fading, r, energy_of(s, &s->filtered, k * n, n))) return 0;
        if (s->G && !predictable(&f->c, fading, r, energy_of(s, &s->guarded, k * n, n))) return 0;
    }
    return 1;
}

static int update_kalman(anc_view *view, const real *error)
{
    kalman *f = (kalman *)view;
    signals *s = &f->s;
    const real fading = *s->setting[FADING], r = *s->setting[STATE_NOISE];
    const int refused = error ? estimate(s, error) : ANC_DONE;
    if (!error || refused) return refused;
    if (!solvable(f, fading, r)) return ANC_NO_SOLUTION;
    for (int32_t sk = 0; sk < s->S * s->K; sk++)
        f->scaled[sk] = least_factor(s, sk / s->K) * s->estimate[sk]; /* eq. 9 */
    predict(&f->c, fading, r);                                        /* eq. 4, once a sample */
    /* The microphones' noises are independent, so they are measured one after the other. */
    for (int32_t k = 0; k < s->K; k++) measure(f, &s->filtered, k, f->scaled);
    for (int32_t k = 0; s->G && k < s->K; k++)
        measure(f, &s->guarded, k, NULL); /* as if w'x'' had been measured as zero */
    commit(s);
    return ANC_DONE;
}

const anc_algorithm anc_kalman = {.name = "Kalman filter",
                                  .settings = kalman_settings,
                                  .layout = layout_kalman,
                                  .start = start_kalman,
                                  .control_signal = filtered_signal,
                                  .update = update_kalman};
