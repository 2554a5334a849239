/* The posterior of the plant alone, used beside any controller. Its references are x, followed by what the loudspeakers play.
 * It plays nothing itself. */
#include "posterior.h"

enum { BLOCK, WINDOW, SPREAD };
static const anc_setting observer_settings[] = {{"block", 1, 65536, ANC_ONE}, {"window", 0, 1, ANC_ONE}, {"spread", 1e-9f, 1000, ANC_ONE}, {0}};

typedef struct {
    signals s;
    posterior posterior;
} observer;

static void layout_observer(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at)
{
    typedef char fits_into_a_view[sizeof(observer) <= sizeof(anc_view) ? 1 : -1];
    observer *f = (observer *)view;
    const real block = plan->settings ? plan->settings[BLOCK] : 1;
    const double most = 1 << 28, K = plan->microphones, J = plan->loudspeakers, I = plan->references - J, L = plan->taps, M = plan->path_taps;
    const double n = I * (L + M - 1) + J * M;
    (void)sizeof(fits_into_a_view);
    if (plan->guard_taps || plan->limited || plan->scenarios != 1 || !(I >= 1 && block >= 1 && block <= 65536) || n > 1 << 14 ||
        K * n > most || (I + J + K) * (2 * L + M + block) > most || (K + 2 * J) * J * M > most || I * J * 2 * (L + M) > most) {
        at->size = SIZE_MAX;
        return;
    }
    layout_unfiltered(&f->s, plan, settings, at);
    signals heard = f->s;
    heard.I -= heard.J;
    layout_posterior(&f->posterior, &heard, (int32_t)block, 0, at);
}

static void start_observer(anc_view *view, const anc_plan *plan, const anc_setting *settings)
{
    observer *f = (observer *)view;
    start_signals(&f->s, plan, settings);
    start_posterior(&f->posterior, *f->s.setting[SPREAD]);
}

/* Take a sample; at the end of a block, learn. */
static int note(anc_view *view, const real *error)
{
    observer *f = (observer *)view;
    for (int32_t k = 0; error && k < f->s.K; k++)
        if (!within(error[k], anc_loudest_learnt)) return ANC_LOUD_ERROR;
    for (int32_t i = 0; i < f->s.I; i++) *place_of(&f->posterior, i) = *newest(&f->s.x, i);
    if (complete_sample(&f->posterior, error)) {
        learn(&f->posterior, root(raised(*f->s.setting[WINDOW], f->posterior.B)));
        begin_block(&f->posterior);
    }
    return ANC_DONE;
}

static int take_signals(anc_view *view, const real *reference, real *control)
{
    observer *f = (observer *)view;
    if (is_too_loud(&f->s, reference)) return ANC_LOUD_REFERENCE;
    if (f->posterior.heard[AWAITED]) note(view, NULL); /* that error never came */
    for (int32_t j = 0; j < f->s.J; j++) control[j] = 0;
    const int refused = take_reference(&f->s, reference);
    f->posterior.heard[AWAITED] = !refused;
    return refused;
}

const anc_algorithm anc_observer = {"observer", observer_settings, layout_observer, start_observer, take_signals, note, note};
