/* $description. See $header.
 *
 * First the files of kfopc_filterpy's core (MIT licence, sources $stamp), in which only
 * the includes were resolved and everything made static. After them: the plan, the state of the
 * export, the calls. */
#ifdef __cplusplus
#error "compile this file as C99; C++ can include its header"
#endif
#undef I /* an earlier <complex.h> defines it, and the core has a member of this name */
$defined#undef ANC_PUBLIC
#define ANC_PUBLIC static
#ifdef __GNUC__ /* not every export needs all of the core */
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-const-variable"
#endif
$core
/* ---- The exported controller ---- */

#include "$header"

#define ALGORITHM anc_$algorithm

$constants
static const anc_plan plan = {
    .scenarios = 1,
    .microphones = $K,
    .loudspeakers = $J,
    .references = $all,
    .taps = $L,
    .path_taps = $M,
    .guard_taps = $G,
    .modelled = $modelled,
    $windows.path = path,
    $guard.settings = settings,
};

/* The state of the export: where it differs from a fresh block, `count` elements of a field from
 * `first` on. */
typedef struct {
    const char *field;
    int32_t first, count;
    const void *values;
} stretch;

static const stretch initial[] = {
$stretches    {0},
};

/* What Python computed for the last samples of the self-test. */
enum { SELF_TEST = $n_samples, COMPARED = $n_compared };
static const real expected[COMPARED][$J] = {
$expected};

typedef char view_has_room[sizeof(anc_view) == sizeof(((${name}_state *)0)->view) ? 1 : -1];

static void fill(void *to, const char *name, anc_role role, anc_type type, size_t offset,
                 const int32_t shape[4])
{
    const size_t size = type == ANC_IS_REAL ? sizeof(real) : sizeof(int32_t);
    (void)role;
    (void)shape;
    for (const stretch *s = initial; s->field; s++) {
        char *field = (char *)to + offset + size * (size_t)s->first;
        if (!strcmp(s->field, name)) memcpy(field, s->values, size * (size_t)s->count);
    }
}

typedef struct { char before; ${name}_state state; } placed; /* a state where its type may stand */
static const uint32_t mark = $mark; /* in every state of this export */

static int usable(const void *state)
{
    return state && (uintptr_t)state % offsetof(placed, state) == 0;
}

/* Find the fields of a state, and set them to those of the export if it is fresh. */
static anc_view *opened(${name}_state *state, int fresh)
{
    anc_view *view = (anc_view *)state->view;
    anc_open(&ALGORITHM, &plan, view, state->block, sizeof state->block, fresh);
    state->opened = state;
    return view;
}

/* Return the view of a usable state; a copy of a state gets its own when it is first used. */
static anc_view *view_of(${name}_state *state)
{
    if (state->mark != mark) ${name}_init(state);
    return state->opened == state ? (anc_view *)state->view : opened(state, 0);
}

/* Set y for x. Time goes on where x is refused: it counts as silence. */
static void take(${name}_state *state, const real *x, real *y)
{
    static const real silence[$room];
    for (int32_t j = 0; j < $J; j++) y[j] = 0;
    if (!usable(state)) return;
    anc_view *view = view_of(state);
    state->fault = ALGORITHM.control_signal(view, x, y);
    if (state->fault) ALGORITHM.control_signal(view, silence, y);
    for (int32_t j = 0; j < $J; j++)
        if (!isfinite(y[j])) y[j] = 0;
}

/* Time goes on after a refused sample, too: it is one that is not adapted to. */
static int adapt(${name}_state *state, const real *e)
{
    if (!usable(state)) return ${NAME}_NO_STATE;
    anc_view *view = view_of(state);
    const int refused = state->fault ? state->fault : ALGORITHM.update(view, e);
    if (refused) ALGORITHM.update(view, NULL);
    return refused;
}

void ${name}_init(${name}_state *state)
{
    if (!usable(state)) return;
    opened(state, 1);
    anc_describe(&ALGORITHM, &plan, fill, state->block);
    state->fault = 0;
    state->mark = mark;
}

$calls
int ${name}_self_test(${name}_state *state)
{
    int differ = !usable(state);
    ${name}_init(state);
    for (int32_t n = 0; n < SELF_TEST; n++) {
        real x[$room] = {0}, e[$K], y[$J];
        for (int32_t i = 0; i < $I; i++) x[i] = (real)((7 * n + 3 * i) % 17 - 8) / 8;
        for (int32_t k = 0; k < $K; k++) e[k] = (real)((5 * n + 2 * k) % 13 - 6) / 8;
        take(state, x, y);
        adapt(state, e);
        for (int32_t j = 0; n >= SELF_TEST - COMPARED && j < $J; j++)
            if (!(y[j] == expected[n - (SELF_TEST - COMPARED)][j])) differ = 1;
    }
    ${name}_init(state);
    return differ;
}
