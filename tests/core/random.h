/* For the two programs beside this file: numbers that are equal on every machine, since they come
 * from integers, and the functions of a library that is loaded at run time (-DLOADED), as Python
 * does it, in place of those linked. */
#ifndef RANDOM_H
#define RANDOM_H
#include "anc.h"
#include <stdint.h>

#ifdef LOADED
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#ifdef _WIN32
#include <windows.h>
#else
#include <dlfcn.h>
#endif
static const char *library;

/* Set a pointer, to data or to a function, to a symbol of the library. */
static void find(void *pointer, const char *name)
{
#ifdef _WIN32
    FARPROC found = GetProcAddress(LoadLibraryA(library), name);
#else
    void *found = dlsym(dlopen(library, RTLD_NOW), name);
#endif
    if (!found) printf("%s has no %s\n", library, name), exit(4);
    memcpy(pointer, &found, sizeof found);
}

static size_t (*size_of)(const anc_algorithm *, const anc_plan *);
static int (*open_block)(const anc_algorithm *, const anc_plan *, anc_view *, void *, size_t, int);
static void (*describe)(const anc_algorithm *, const anc_plan *, anc_visitor *, void *);
static int64_t (*listen_to_block)(const anc_algorithm *, anc_view *, const anc_real *,
                                  const anc_real *, const uint8_t *, int64_t, int32_t *);
static void (*refilter_block)(anc_view *);
static int (*take_error_of)(anc_view *, const anc_real *);
static int64_t (*run_loop)(const anc_controller *, anc_plant *, const anc_signals *,
                           const anc_record *, int32_t, int64_t, int64_t, int32_t *);
#define anc_size size_of
#define anc_open open_block
#define anc_describe describe
#define anc_run run_loop
#define anc_listen listen_to_block
#define anc_refilter refilter_block
#define anc_take_error take_error_of
#define ALGORITHM(name) "anc_" #name, NULL
#else
#define ALGORITHM(name) "anc_" #name, &anc_##name
#endif

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
