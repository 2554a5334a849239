/* Numbers for the two programs beside this file: equal on every machine, since they come from integers. */
#ifndef RANDOM_H
#define RANDOM_H
#include "anc.h"
#include <stdint.h>

static uint64_t random_state = 1;

/* Return one of 2^31 integers (Knuth's MMIX generator, whose upper bits are good). */
static uint32_t random_bits(void)
{
    random_state = random_state * 6364136223846793005u + 1442695040888963407u;
    return (uint32_t)(random_state >> 33);
}

/* Return an integer from 0 to n - 1. */
static int32_t below(int32_t n) { return (int32_t)(random_bits() % (uint32_t)n); }

/* Return a number from -1 to 1 with 20 bits, so that float holds it too. */
static anc_real noise(void) { return (anc_real)(below(1 << 21) - (1 << 20)) / (anc_real)(1 << 20); }

/* How many numbers a setting has. */
static int32_t numbers(const anc_setting *setting, const anc_plan *plan)
{
    const int32_t each[] = {1, plan->loudspeakers, plan->microphones};
    return each[setting->each];
}
#endif
