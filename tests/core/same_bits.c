/* Runs every algorithm in the loop on fixed noise and prints a hash of the signals and one of the
 * blocks' states. The output must be the same for every compiler, flag, processor and system: see
 * test_same_bits.py, which also writes algorithms.h. */
#include "random.h"
#include "algorithms.h"
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum {
    TAPS = 21,
    PATH = 13,
    GUARD = 5,
    SAMPLES = 700,
    LISTENED = 100,
    WINDOW = 50,
    MOST = 3
}; /* no multiples of 8 */

typedef struct {
    uint64_t value;
    const char *block;
} hash;

/* Take the bits of a number, the lowest byte first (FNV-1a). NaN is one value: its sign differs
 * between processors. */
static void take(hash *h, uint64_t bits, size_t bytes)
{
    for (size_t b = 0; b < bytes; b++)
        h->value = (h->value ^ (bits >> 8 * b & 255)) * 1099511628211u;
}

static void take_real(hash *h, anc_real number)
{
#ifdef ANC_FLOAT
    uint32_t bits = 0x7fc00000u;
#else
    uint64_t bits = 0x7ff8000000000000u;
#endif
    if (!isnan(number)) memcpy(&bits, &number, sizeof bits);
    take(h, bits, sizeof bits);
}

static void take_field(void *to, const char *name, anc_role role, anc_type type, size_t offset,
                       const int32_t shape[4])
{
    hash *h = to;
    const char *field = h->block + offset;
    const size_t n = (size_t)shape[0] * (size_t)shape[1] * (size_t)shape[2] * (size_t)shape[3];
    (void)name;
    for (size_t i = 0; role != ANC_SCRATCH && i < n; i++) {
        anc_real number;
        int32_t count;
        if (type == ANC_IS_REAL)
            memcpy(&number, field + i * sizeof number, sizeof number), take_real(h, number);
        else
            memcpy(&count, field + i * sizeof count, sizeof count),
                take(h, (uint32_t)count, sizeof count);
    }
}

/* A limiter that acts: the numbers are those of power/limiter.py in kind, and without exp. */
static anc_limiter limiter_of(anc_real budget)
{
    anc_limiter c = {.scale = 1,
                     .peak = 1,
                     .budget = budget,
                     .limit = 2,
                     .planned = 16,
                     .attack = 0.125f,
                     .calm = 0.96875f,
                     .fade = 0.9921875f,
                     .release = 0.25f,
                     .size = WINDOW,
                     .spans = 2,
                     .average = 1e-30f,
                     .loud = 1e-30f,
                     .gain = 1};
    c.horizon[0] = WINDOW / 2, c.horizon[1] = WINDOW;
    c.held[0] = c.held[1] = 1e-30f, c.room[0] = 1, c.room[1] = 0.96875f;
    return c;
}

/* PAUSED: after listening, with an internal model and a changed path, and not always adapting. */
enum { PLAIN, EQUIPPED, HARD, PAUSED };

typedef struct {
    char *block;
    int kind;
} equipment;

/* Put limiters, amplifier models and computed factors into a block; PAUSED: a sharp amplifier, a
 * power and gains that are known, and another path. */
static void equip(void *to, const char *name, anc_role role, anc_type type, size_t offset,
                  const int32_t shape[4])
{
    const int paused = ((equipment *)to)->kind == PAUSED;
    char *field = ((equipment *)to)->block + offset;
    (void)role, (void)type;
    for (int32_t j = 0; j < shape[2]; j++) {
        if (!strcmp(name, "limiter"))
            ((anc_limiter *)(void *)field)[j] = limiter_of(0.25f + (anc_real)j);
        if (!strcmp(name, "amplifier"))
            ((anc_amplifier *)(void *)field)[j] =
                (anc_amplifier){(anc_real)((j + 2 * paused) % 3), 0.5f, paused ? 1 << 20 : 1.75f};
        if (!strcmp(name, "secondary_path") && paused)
            ((anc_real *)(void *)field)[j * shape[3]] += 0.0625f;
        if (!strcmp(name, "constraint")) {
            anc_constraint *c = (anc_constraint *)(void *)field + j;
            c->rated_power = 0.015625f, c->rate = 0.0078125f, c->supplied_factor = (anc_real)NAN;
            if (paused && j == 0) c->supplied_power = 0.75f;
            if (paused && j > 0) c->supplied_gain = (anc_real)(j - 1);
        }
    }
}

/* The controller as the loop sees it. */
typedef struct {
    const anc_algorithm *algorithm;
    anc_view view;
    int32_t pause, updates; /* it does not adapt to each error of this number; 0: to all */
} controller;
static int control_signal(void *self, const anc_real *x, anc_real *y)
{
    return ((controller *)self)->algorithm->control_signal(&((controller *)self)->view, x, y);
}
static int update(void *self, const anc_real *e)
{
    controller *c = self;
    if (!c->pause || ++c->updates % c->pause) return c->algorithm->update(&c->view, e);
    return anc_take_error(&c->view, e) || c->algorithm->update(&c->view, NULL);
}

static anc_real signal[4 * MOST][SAMPLES], reference[MOST][SAMPLES], disturbance[MOST][SAMPLES];

/* Make the input hard: tones, which excite few directions, first softly, with silence between; and
 * a click. */
static void harden(int32_t K, int32_t I, anc_real click)
{
    static const anc_real period[8] = {1, 0.75f, 0, -0.75f, -1, -0.75f, 0, 0.75f};
    for (int32_t n = 0; n < SAMPLES; n++) {
        const anc_real level = n < 64 ? 0x1p-20f : n < 300 || n >= 350 ? 1 : 0;
        for (int32_t i = 0; i < I; i++) reference[i][n] = level * period[(n + i) % 8];
        for (int32_t k = 0; k < K; k++)
            disturbance[k][n] = level * period[(n + 3 * k) % 8] + (n == 400 ? click : 0);
    }
}

/* Let the noise set in late; a click in the errors; another primary path; a click in the
 * references; a silence, and then a louder noise. */
static void change(int32_t K, int32_t I)
{
    for (int32_t n = 0; n < SAMPLES; n++) {
        const anc_real level = n < 500 ? 1 : n < 560 ? 0 : 16;
        for (int32_t i = 0; i < I; i++) reference[i][n] *= n == 450 ? 64 : level;
        for (int32_t k = 0; k < K; k++) {
            disturbance[k][n] *= n < 70 ? 0 : n < 400 ? 1 : -level;
            if (n == 350) disturbance[k][n] += 256;
        }
    }
}

/* Silence one of several loudspeakers and references; a single reference, at first. */
static void silence(int32_t K, int32_t J, anc_real *path, anc_real *estimated)
{
    if (J == 1) memset(reference[0], 0, 80 * sizeof(anc_real));
    if (J > 1) memset(reference[1], 0, sizeof reference[1]);
    for (int32_t k = 0; J > 1 && k < K; k++)
        for (int32_t m = 0, last = (k * J + J - 1) * PATH; m < PATH; m++)
            path[last + m] = estimated[last + m] = 0;
}

/* Run an algorithm of a shape: plain; equipped with a guard, limiters, amplifiers, windows and
 * computed factors; on hard input; or paused. */
static void run(int32_t number, int32_t K, int32_t J, int32_t I, int kind)
{
    static const char *const kinds[] = {"plain", "equipped", "hard", "paused"};
    const int equipped = kind == EQUIPPED, paused = kind == PAUSED;
    const int learns_paths = !strcmp(algorithms[number].name, "anc_power_budget");
    static anc_real estimated[MOST * MOST * PATH], path[MOST * MOST * PATH],
        feedback[MOST * MOST * PATH], guard[GUARD], settings[8 * MOST];
    static anc_real output[MOST * (4 * PATH + 64)], present[3 * MOST];
    const int32_t windows[MOST] = {WINDOW, WINDOW, WINDOW},
                  power_windows[MOST] = {WINDOW, 0, WINDOW / 2};
    const anc_real loudest = kind == HARD ? 1e35f : 1e6f, limit[MOST] = {loudest, loudest, loudest};
    const anc_amplifier amplifiers[MOST] = {
        {ANC_SOFT_SATURATION, 0.5f, 1.75f}, {ANC_HARD_CLIP, 0.5f, 1}, {ANC_LINEAR, 1, 1}};
    controller c = {.algorithm = algorithms[number].algorithm, .pause = paused ? 8 : 0};
    const anc_plan plan = {.scenarios = 1,
                           .microphones = K,
                           .loudspeakers = J,
                           .references = I,
                           /* half the length of the transforms is a power of four, or not */
                           .taps = learns_paths && equipped ? TAPS - 1 : TAPS,
                           .path_taps = PATH,
                           .guard_taps =
                               !learns_paths && (equipped || (paused && K > 1)) ? GUARD : 0,
                           .modelled = paused,
                           .power_windows = equipped ? power_windows : NULL,
                           .limiter_windows = equipped ? windows : NULL,
                           .path = estimated,
                           .guard = guard,
                           .settings = settings};
    anc_plant plant = {.scenarios = 1,
                       .microphones = K,
                       .loudspeakers = J,
                       .references = I,
                       .path_taps = PATH,
                       .feedback_taps = equipped ? PATH : 0,
                       .at = 3 * PATH + 64,
                       .length = 4 * PATH + 64,
                       .path = path,
                       .feedback = feedback,
                       .amplifiers = amplifiers,
                       .output = output,
                       .reference = present,
                       .control = present + MOST,
                       .error = present + 2 * MOST,
                       .limit = limit};
    const anc_signals signals = {SAMPLES,   reference[0], disturbance[0],   NULL,
                                 signal[0], signal[MOST], signal[2 * MOST], signal[3 * MOST]};
    const anc_controller seen = {&c, control_signal, update, NULL};
    uint8_t adapt[LISTENED];
    int32_t status = ANC_RUNNING, answer = ANC_DONE;
    hash y = {14695981039346656037u, NULL}, states = y;
    anc_real *value = settings, size = 0.5f;

    random_state = 1;
    for (int i = 0; c.algorithm->settings[i].name; i++)
        for (int32_t n = 0; n < numbers(c.algorithm->settings + i, &plan); n++)
            *value++ = algorithms[number].settings[kind][i];
    for (int32_t n = 0; n < K * J * PATH; n++, size = n % PATH ? size * 0.75f : 0.5f) {
        path[n] = n % PATH < 2 ? 0 : size * noise();
        estimated[n] = path[n] + size * noise() / 16;
        feedback[n % (I * J * PATH)] = size * noise() / 64;
    }
    for (int32_t g = 0; g < GUARD; g++) guard[g] = noise() / 16;
    for (int32_t n = 0; n < SAMPLES; n++) {
        for (int32_t i = 0; i < I; i++) reference[i][n] = noise();
        for (int32_t k = 0; k < K; k++)
            disturbance[k][n] = (n < 6 ? 0 : reference[k % I][n - 6]) + noise() / 32;
    }
    if (kind == HARD)
        harden(K, I, sizeof(anc_real) == sizeof(float) || learns_paths ? 4096 : 1e30f);
    if (learns_paths && (equipped || paused)) change(K, I);
    if (learns_paths && kind == HARD) silence(K, J, path, estimated);
    memset(signal, 0, sizeof signal), memset(output, 0, sizeof output),
        memset(present, 0, sizeof present);

    printf("%s %s %d %d %d ", algorithms[number].name + 4, kinds[kind], (int)K, (int)J, (int)I);
    const size_t bytes = anc_size(c.algorithm, &plan);
    void *room = malloc(bytes + 64), *block = (char *)room + (64 - (uintptr_t)room % 64) % 64;
    if (!bytes || !room || !anc_open(c.algorithm, &plan, &c.view, block, bytes, 1)) {
        puts("refused");
        free(room);
        return;
    }
    for (int32_t n = 0; n < LISTENED; n++) adapt[n] = n % 16 != 7;
    if (paused)
        anc_listen(c.algorithm, &c.view, reference[0], disturbance[0], adapt, LISTENED, &answer);
    if (equipped || paused) anc_describe(c.algorithm, &plan, equip, &(equipment){block, kind});
    if (paused) anc_refilter(&c.view);
    const int64_t done = anc_run(&seen, &plant, &signals, NULL, 0, 0, SAMPLES, &status);
    for (int32_t row = 0; row < 4 * MOST; row++)
        for (int32_t n = 0; n < SAMPLES; n++) take_real(&y, signal[row][n]);
    states.block = block;
    anc_describe(c.algorithm, &plan, take_field, &states);
    printf("%d %016" PRIx64 " %016" PRIx64 "\n", (int)done, y.value, states.value);
    free(room);
}

int main(int argc, char **argv)
{
#ifdef LOADED
    library = argc > 1 ? argv[1] : "";
    find(&size_of, "anc_size"), find(&open_block, "anc_open"), find(&describe, "anc_describe"),
        find(&run_loop, "anc_run"), find(&listen_to_block, "anc_listen"),
        find(&refilter_block, "anc_refilter"), find(&take_error_of, "anc_take_error");
    for (int32_t number = 0; algorithms[number].name; number++)
        find(&algorithms[number].algorithm, algorithms[number].name);
#endif
    (void)argc, (void)argv;
    for (int32_t number = 0; algorithms[number].name; number++)
        for (int kind = PLAIN; kind <= PAUSED; kind++) {
            run(number, 1, 1, 1, kind);
            run(number, 2, 3, 2, kind);
        }
    return 0;
}
