/* What a host calls: measure, open and describe a block. */
#include "signals.h"

/* Of the windows: positions in them are reals, and a float counts no further. */
#ifdef ANC_FLOAT
static const double LONGEST = 1 << 24;
#else
static const double LONGEST = 1 << 28;
#endif

static int in_range(const anc_setting *setting, real value)
{
    const int below = setting->most == 0 ? isfinite(value) : value <= setting->most;
    return value >= setting->least && below;
}

static int all_finite(const real *values, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

/* Return whether all counts that a block needs fit into an int32. */
static int shape_accepted(const anc_plan *p)
{
    const int32_t shape[] = {p->scenarios,  p->microphones, p->loudspeakers,
                             p->references, p->taps,        p->path_taps};
    const double most = 1 << 28, G = ANC_GUARD_TAPS, S = p->scenarios;
    const double K = p->microphones, J = p->loudspeakers, I = p->references;
    const double L = p->taps, M = p->path_taps, kinds = ANC_POWERS;
    for (int i = 0; i < 6; i++)
        if (shape[i] < 1 || shape[i] > most) return 0;
    if (p->modelled && (S != 1 || I < K)) return 0;
    if (p->guard_taps < 0 || p->guard_taps > G) return 0;
    if (S * J * I * L > most || S * K > most || S * J * (4 * M + 64) > most) return 0;
    for (int32_t sj = 0; sj < p->scenarios * p->loudspeakers; sj++) {
        const double powers = p->power_windows ? p->power_windows[sj] : 0;
        const double limiter = p->limiter_windows ? p->limiter_windows[sj] : 1;
        if (!(powers >= 0 && powers <= LONGEST && S * J * kinds * powers <= most)) return 0;
        if (!(limiter >= 1 && limiter <= LONGEST && S * J * limiter * 3 <= most)) return 0;
    }
    return K * J * I * (4 * L + 4 * G + 64) <= most &&
           (I + K * J) * (4 * (L + M) + 8 * G + 64) <= most;
}

static int values_accepted(const anc_algorithm *a, const anc_plan *p)
{
    const real *value = p->settings;
    if (!p->path || (a->settings->name && !value) || (p->guard_taps && !p->guard)) return 0;
    for (const anc_setting *setting = a->settings; setting->name; setting++)
        for (int32_t n = 0; n < numbers_of(setting, p); n++)
            if (!in_range(setting, *value++)) return 0;
    return all_finite(p->path, times(p->microphones * p->loudspeakers, p->path_taps)) &&
           all_finite(p->guard, (size_t)p->guard_taps);
}

/* Find the fields of a block. */
static void lay_out(const anc_algorithm *a, const anc_plan *plan, anc_view *view, anc_layout *at)
{
    layout_signals((signals *)view, plan, a->settings, !a->unfiltered, at);
    if (a->layout) a->layout(view, plan, at);
}

size_t anc_size(const anc_algorithm *a, const anc_plan *plan)
{
    anc_view view;
    anc_layout at = {0};
    if (!shape_accepted(plan)) return 0;
    lay_out(a, plan, &view, &at);
    return at.size == SIZE_MAX ? 0 : at.size;
}

int anc_open(const anc_algorithm *a, const anc_plan *plan, anc_view *view, void *block,
             size_t bytes, int fresh)
{
    const size_t size = anc_size(a, plan);
    anc_layout at = {.memory = block};
    if (!size || bytes < size || (uintptr_t)block % sizeof(real)) return 0;
    if (fresh && !values_accepted(a, plan)) return 0;
    if (fresh) memset(block, 0, size);
    lay_out(a, plan, view, &at);
    if (fresh) start_signals((signals *)view, plan, a->settings);
    if (fresh && a->start) a->start(view);
    return 1;
}

void anc_describe(const anc_algorithm *a, const anc_plan *plan, anc_visitor *visit, void *to)
{
    anc_view view;
    anc_layout at = {.visit = visit, .to = to};
    if (shape_accepted(plan)) lay_out(a, plan, &view, &at);
}
