/* Makes controllers of random shapes and settings, most of them odd, and runs each: any_plan SEED
 * PLANS. A plan is refused, or its controller stays within its bytes, which the sanitizers watch;
 * and a step that is refused changes no state or setting. */
#include "random.h"
#include "algorithms.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SAMPLES = 50, MOST = 5, LONGEST = 80 };

/* Return a number of any kind. */
static anc_real any(void)
{
    static const anc_real odd[] = {0,
                                   -0.0f,
                                   1,
                                   -1,
                                   2,
                                   1e-30f,
                                   -1e-30f,
                                   1e10f,
                                   1e13f,
                                   1e30f,
                                   3e38f,
                                   -3e38f,
                                   (anc_real)NAN,
                                   (anc_real)INFINITY,
                                   -(anc_real)INFINITY};
    anc_real number = odd[below(sizeof odd / sizeof *odd)];
    if (below(4) == 0) number *= number; /* in double also beyond the range of float */
    return below(3) ? noise() : number;
}

static anc_real mostly_noise(void) { return below(40) ? noise() : any(); }

/* Return a count, mostly small, at times not even possible. */
static int32_t any_count(int32_t most)
{
    static const int32_t odd[] = {0, -1, INT32_MIN, INT32_MAX, 1 << 28, 1 << 20, 1 << 14};
    return below(30) ? 1 + below(most) : odd[below(sizeof odd / sizeof *odd)];
}

/* What a step must not change, if it is refused. */
typedef struct {
    char *block, *copy;
    const char *changed;
} kept;

static void compare(void *to, const char *name, anc_role role, anc_type type, size_t offset,
                    const int32_t shape[4])
{
    kept *k = to;
    const size_t bytes = (size_t)shape[0] * (size_t)shape[1] * (size_t)shape[2] * (size_t)shape[3] *
                         (type == ANC_IS_REAL ? sizeof(anc_real) : sizeof(int32_t));
    if (role != ANC_SCRATCH && memcmp(k->block + offset, k->copy + offset, bytes))
        k->changed = name;
}

static const char *changed_by_refusal(const anc_algorithm *a, const anc_plan *plan, char *block,
                                      char *copy)
{
    kept k = {block, copy, NULL};
    anc_describe(a, plan, compare, &k);
    return k.changed;
}

static int run(const anc_algorithm *a, const anc_plan *plan, size_t bytes)
{
    anc_view view;
    char *block = malloc(bytes), *copy = malloc(bytes);
    anc_real *x = malloc(sizeof *x * (size_t)plan->references),
             *y = malloc(sizeof *y * (size_t)(plan->scenarios * plan->loudspeakers));
    const int32_t errors = plan->scenarios * plan->microphones;
    anc_real *e = malloc(sizeof *e * (size_t)errors); /* each of just its bytes */
    if (!block || !copy || !x || !y || !e) exit(2);
    const int opened = anc_open(a, plan, &view, block, bytes, 1);
    for (int n = 0; opened && n < SAMPLES; n++) {
        for (int32_t i = 0; i < plan->references; i++) x[i] = mostly_noise();
        for (int32_t k = 0; k < errors; k++) e[k] = mostly_noise();
        for (int half = 0; half < 2; half++) {
            memcpy(copy, block, bytes);
            const int answer =
                half ? a->update(&view, below(10) ? e : NULL) : a->control_signal(&view, x, y);
            const char *changed = answer ? changed_by_refusal(a, plan, block, copy) : NULL;
            if (changed)
                printf("%s: a refused %s changed %s\n", a->name, half ? "update" : "control_signal",
                       changed),
                    exit(1);
        }
        if (n ==
            SAMPLES / 2) { /* moved in memory, it goes on; then its references are filtered again */
            memcpy(copy, block, bytes);
            char *other = block;
            block = copy, copy = other;
            if (!anc_open(a, plan, &view, block, bytes, 0)) exit(3);
            anc_refilter(&view);
        }
    }
    free(block), free(copy), free(x), free(y), free(e);
    return opened;
}

int main(int argc, char **argv)
{
    if (argc != 3) return 2;
    random_state = strtoul(argv[1], NULL, 10);
    const long plans = strtol(argv[2], NULL, 10);
    int32_t known = 0, opened = 0;
    while (algorithms[known].name) known++;
    for (long i = 0; i < plans; i++) {
        const int32_t number = below(known);
        const anc_algorithm *a = algorithms[number].algorithm;
        anc_plan plan = {.scenarios = any_count(MOST),
                         .microphones = any_count(MOST),
                         .loudspeakers = any_count(MOST),
                         .references = any_count(MOST),
                         .taps = any_count(LONGEST),
                         .path_taps = any_count(LONGEST),
                         .guard_taps = below(2) ? any_count(48) : 0,
                         .modelled = !below(4)};
        const int tidy = below(2); /* so that many plans are not refused */
        int32_t windows[2][MOST * MOST];
        for (int32_t j = 0; j < MOST * MOST; j++)
            windows[0][j] = below(3) ? any_count(LONGEST) : 0, windows[1][j] = any_count(LONGEST);
        plan.power_windows = below(2) ? windows[0] : NULL;
        plan.limiter_windows = below(2) ? windows[1] : NULL;
        if (plan.loudspeakers > MOST || plan.scenarios > MOST)
            plan.power_windows = plan.limiter_windows = NULL;
        anc_real settings[8 * (MOST + 1)], *value = settings;
        const int few =
            plan.scenarios <= MOST && plan.loudspeakers <= MOST && plan.microphones <= MOST;
        for (int s = 0; few && a->settings[s].name; s++)
            for (int32_t n = 0; n < numbers(a->settings + s, &plan); n++)
                *value++ = tidy ? algorithms[number].settings[0][s] : any();
        plan.settings = few ? settings : NULL; /* the size may depend on them */
        const size_t bytes = anc_size(a, &plan);
        if (!bytes || bytes > 1 << 22 || !few)
            continue; /* refused, or as large as a test should be */
        const int32_t taps = plan.microphones * plan.loudspeakers * plan.path_taps;
        anc_real *path = malloc(sizeof *path * (size_t)taps),
                 *guard = malloc(sizeof *guard * (size_t)(plan.guard_taps + 1));
        if (!path || !guard) return 2;
        for (int32_t n = 0; n < taps; n++) path[n] = tidy ? noise() : mostly_noise();
        for (int32_t n = 0; n < plan.guard_taps; n++) guard[n] = tidy ? noise() : mostly_noise();
        plan.path = path, plan.guard = guard;
        opened += run(a, &plan, bytes);
        free(path), free(guard);
    }
    printf("%d of %ld plans ran\n", (int)opened, plans);
    return 0;
}
