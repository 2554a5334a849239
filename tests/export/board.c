/* Runs an exported controller, named anc and of one channel, in a loop with a short path, and prints what it did: on an
 * emulated Cortex-M4, where it also counts instructions and the bytes of stack, or on any host.
 *
 * Each line is a name and a number in hexadecimal. `bits` is a hash of all control signals so far. */
#include "anc.h"

#include <stdint.h>
#include <string.h>

enum { LINES = 8 }; /* of `bits`, at equal distances */

#ifdef __arm__
extern uint32_t end_of_data[], top_of_stack[];

enum { SYS_WRITE0 = 4, SYS_EXIT = 0x18, PAINT = 0x5a5a5a5a, LEFT_BLANK = 256 };
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xe000e010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xe000e014)
#define SYSTICK_NOW (*(volatile uint32_t *)0xe000e018)
#define FPU_ACCESS (*(volatile uint32_t *)0xe000ed88)

static void semihosting(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

static void print(const char *text) { semihosting(SYS_WRITE0, text); }

/* Ticks of 25 MHz; qemu's -icount shift=0 takes 1 ns for an instruction, so a tick is 40 of them. */
static uint32_t ticks(void) { return SYSTICK_NOW; }

static uint32_t instructions(uint32_t from, uint32_t to) { return 40 * ((from - to) & 0xffffff); }

/* Paint the free memory, to see later how far the stack came down. */
static void paint(void)
{
    uint32_t here;
    for (uint32_t *word = end_of_data; word < &here - LEFT_BLANK; word++) *word = PAINT;
}

static uint32_t stack_bytes(void)
{
    const uint32_t *word = end_of_data;
    while (*word == PAINT) word++;
    return (uint32_t)((uintptr_t)top_of_stack - (uintptr_t)word);
}

int main(void);

static void stop(void)
{
    semihosting(SYS_EXIT, (void *)0x20026); /* the application has ended */
    for (;;) {
    }
}

static void failed(void)
{
    print("fault 1\n");
    stop();
}

static void reset(void)
{
    FPU_ACCESS |= 0xfu << 20;
    __asm__ volatile("dsb\n isb" ::: "memory");
    SYSTICK_RELOAD = 0xffffff;
    SYSTICK_CONTROL = 5; /* on, at the processor's clock, without interrupts */
    main();
    stop();
}

__attribute__((section(".vectors"), used)) static void *const vectors[] = {
    top_of_stack, (void *)reset, (void *)failed, (void *)failed, (void *)failed, (void *)failed, (void *)failed};
#else
#include <stdio.h>

static void print(const char *text) { fputs(text, stdout); }
static uint32_t ticks(void) { return 0; }
static uint32_t instructions(uint32_t from, uint32_t to) { return from - to; }
static void paint(void) {}
static uint32_t stack_bytes(void) { return 0; }
#endif

static void say(const char *name, uint32_t value)
{
    char digits[] = " 00000000\n";
    for (int k = 0; k < 8; k++) digits[1 + k] = "0123456789abcdef"[value >> (28 - 4 * k) & 15];
    print(name);
    print(digits);
}

static uint32_t seed = 1;

static float uniform(void) /* from -1 to 1 */
{
    seed = seed * 1664525u + 1013904223u;
    return (float)(int32_t)seed / 2147483648.0f;
}

static anc_state state;

int main(void)
{
    static const float secondary[] = {SECONDARY};
    enum { PATH = sizeof secondary / sizeof *secondary, DELAY = 4 };
    float played[PATH] = {0}, heard[DELAY] = {0};
    uint32_t bits = 2166136261u, worst = 0; /* FNV-1a */
    uint64_t late = 0;
    paint();
    say("self_test", (uint32_t)anc_self_test(&state));
    for (int n = 0; n < SAMPLES; n++) {
        const float x = uniform();
        memmove(heard + 1, heard, (DELAY - 1) * sizeof *heard);
        heard[0] = x;
        const uint32_t began = ticks();
        const float y = anc_control_signal(&state, x);
        const uint32_t given = ticks();
        memmove(played + 1, played, (PATH - 1) * sizeof *played);
        played[0] = y;
        float e = heard[DELAY - 1] + 0.01f * uniform();
        for (int k = 0; k < PATH; k++) e -= secondary[k] * played[k];
        const uint32_t resumed = ticks();
        anc_update(&state, e);
        const uint32_t took = instructions(began, given) + instructions(resumed, ticks());
        worst = took > worst ? took : worst;
        late += n < SAMPLES / 2 ? 0 : took;
        uint32_t word;
        memcpy(&word, &y, sizeof word);
        bits = (bits ^ word) * 16777619u;
        if ((n + 1) % (SAMPLES / LINES) == 0) say("bits", bits);
    }
    say("mean", (uint32_t)(late / (SAMPLES - SAMPLES / 2)));
    say("worst", worst);
    say("stack", stack_bytes());
    say("state", sizeof state);
    return 0;
}
