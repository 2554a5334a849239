/* What a host calls: measure, open, describe. */
#include "signals.h"
#include <string.h>

#ifdef ANC_FLOAT
enum { LONGEST = 1 << 24 }; /* of the windows: positions in them are reals, and a float counts no further */
#else
enum { LONGEST = 1 << 28 };
#endif

static int in_range(const anc_setting *setting, real value)
{
    return value >= setting->least && (setting->most == 0 ? isfinite(value) : value <= setting->most);
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
    const int32_t shape[] = {p->scenarios, p->microphones, p->loudspeakers, p->references, p->taps, p->path_taps};
    const double most = (1 << 28), K = p->microphones, J = p->loudspeakers, I = p->references, L = p->taps, M = p->path_taps;
    const double S = p->scenarios;
    for (int i = 0; i < 6; i++)
        if (shape[i] < 1 || shape[i] > most) return 0;
    if (p->modelled && (p->scenarios != 1 || p->references < p->microphones)) return 0;
    if (p->guard_taps < 0 || p->guard_taps > ANC_GUARD_TAPS || (p->limited && !p->limiter_windows)) return 0;
    if (S * J * I * L > most || S * K > most || S * J * (4 * M + 64) > most) return 0;
    for (int32_t sj = 0; sj < p->scenarios * p->loudspeakers; sj++) {
        const double power = p->power_windows ? p->power_windows[sj] : 0, limiter = p->limited ? p->limiter_windows[sj] : 1;
        if (power < 0 || power > (double)LONGEST || S * J * power * (double)ANC_POWERS > most) return 0;
        if (limiter < 1 || limiter > (double)LONGEST || S * J * limiter * 3 > most) return 0;
    }
    return K * J * I * (4 * L + 4 * ANC_GUARD_TAPS + 64) <= most && (I + K * J) * (4 * (L + M) + 8 * ANC_GUARD_TAPS + 64) <= most;
}

static int values_accepted(const anc_algorithm *a, const anc_plan *p)
{
    const real *value = p->settings;
    if (!p->path || (a->settings->name && !value) || (p->guard_taps && !p->guard)) return 0;
    for (int i = 0; a->settings[i].name; i++)
        for (int32_t n = 0; n < numbers_of(a->settings + i, p); n++)
            if (!in_range(a->settings + i, *value++)) return 0;
    return all_finite(p->path, times(p->microphones * p->loudspeakers, p->path_taps)) && all_finite(p->guard, (size_t)p->guard_taps);
}

size_t anc_size(const anc_algorithm *a, const anc_plan *plan)
{
    anc_view view;
    anc_layout at = {0};
    if (!shape_accepted(plan)) return 0;
    a->layout(&view, plan, a->settings, &at);
    return at.size == SIZE_MAX ? 0 : at.size;
}

int anc_open(const anc_algorithm *a, const anc_plan *plan, anc_view *view, void *block, size_t bytes, int fresh)
{
    const size_t size = anc_size(a, plan);
    anc_layout at = {.memory = block};
    if (!size || bytes < size || (uintptr_t)block % sizeof(real) || (fresh && !values_accepted(a, plan))) return 0;
    if (fresh) memset(block, 0, size);
    a->layout(view, plan, a->settings, &at);
    if (fresh) a->start(view, plan, a->settings);
    return 1;
}

void anc_describe(const anc_algorithm *a, const anc_plan *plan, anc_visitor *visit, void *to)
{
    anc_view view;
    anc_layout at = {.visit = visit, .to = to};
    if (shape_accepted(plan)) a->layout(&view, plan, a->settings, &at);
}
