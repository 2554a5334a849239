/* Arithmetic whose order is fixed, so that every compiler and processor gives the same bits: sums go to PARTS partial sums,
 * element p to part p % PARTS. Compile without contraction or reassociation: building.py lists the flags. */
#ifndef VECTORS_H
#define VECTORS_H
#include "anc.h"
#include <float.h>
#include <math.h>

typedef anc_real real;

#if defined __FAST_MATH__ || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__) || defined __ASSOCIATIVE_MATH__ || \
    defined __RECIPROCAL_MATH__ || (defined FLT_EVAL_METHOD && FLT_EVAL_METHOD != 0)
#error "the core promises equal bits: compile it without -ffast-math, and not for the x87"
#endif

enum { PARTS = 8 };
#ifndef __GNUC__ /* and clang */
#define LANES_OF_ONE 1
#endif
#if LANES_OF_ONE
enum { LANES = 1 };
#elif defined __AVX512F__
enum { LANES = 64 / sizeof(real) };
#elif defined __AVX__
enum { LANES = 32 / sizeof(real) };
#elif defined __SSE2__ || defined __ARM_NEON || defined __wasm_simd128__
enum { LANES = 16 / sizeof(real) };
#else
enum { LANES = 1 };
#endif
enum { WIDE = (int)LANES < (int)PARTS ? (int)LANES : (int)PARTS, VECTORS = PARTS / WIDE };
#if LANES_OF_ONE
typedef real vector; /* for compilers without vectors: the same order, the same bits */
#else
typedef real vector __attribute__((vector_size(WIDE * sizeof(real)), aligned(sizeof(real)), may_alias));
#endif

static const vector zero;

/* Vector v of the PARTS elements at p. */
static inline const vector *vectors(const real *p) { return (const vector *)(const void *)p; }
static inline vector *vectors_of(real *p) { return (vector *)(void *)p; }

/* Return the square root, rounded correctly. */
static inline real root(real square)
{
#ifdef ANC_FLOAT
    return sqrtf(square);
#else
    return sqrt(square);
#endif
}

/* Add up the partial sums. */
static inline real total(const real p[PARTS])
{
    return ((p[0] + p[4]) + (p[2] + p[6])) + ((p[1] + p[5]) + (p[3] + p[7]));
}

/* Return a'b. */
static inline real dot(const real *restrict a, const real *restrict b, int32_t n)
{
    vector sum[VECTORS];
    real part[PARTS];
    int32_t i = 0;
    for (int v = 0; v < VECTORS; v++) sum[v] = zero;
    for (; i + PARTS <= n; i += PARTS)
        for (int v = 0; v < VECTORS; v++) sum[v] += vectors(a + i)[v] * vectors(b + i)[v];
    for (int v = 0; v < VECTORS; v++) vectors_of(part)[v] = sum[v];
    for (int p = 0; i < n; i++, p++) part[p] += a[i] * b[i];
    return total(part);
}

/* Return the next value, but at least `down` and at most `up` times the last one. */
static inline real held_value(real last, real next, real down, real up)
{
    return next < last * down ? last * down : next > last * up ? last * up : next;
}

/* Set to = to + a from. */
static inline void add_scaled(real *restrict to, real a, const real *restrict from, int32_t n)
{
    for (int32_t i = 0; i < n; i++) to[i] += a * from[i];
}

/* Set w = keep w - a x. */
static inline void shrink(real *restrict w, real keep, real a, const real *restrict x, int32_t n)
{
    for (int32_t i = 0; i < n; i++) w[i] = keep * w[i] - a * x[i];
}
#endif
