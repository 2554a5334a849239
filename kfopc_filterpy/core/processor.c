/* Tells which of the libraries for x86 levels this processor and its system can run. */
#include "anc.h"

/* Return 1, 3 or 4, of the x86 psABI's levels v1, v3 and v4; 1 on other processors. */
extern ANC_PUBLIC int32_t anc_processor_level(void);

#if defined __x86_64__ && defined __GNUC__
/* zig has no run-time support for __builtin_cpu_supports, so the processor is asked here. */
static void ask(uint32_t leaf, uint32_t r[4]) /* eax, ebx, ecx, edx */
{
    __asm__("cpuid" : "=a"(r[0]), "=b"(r[1]), "=c"(r[2]), "=d"(r[3]) : "a"(leaf), "c"(0));
}

static int has(uint32_t bits, uint32_t wanted) { return (bits & wanted) == wanted; }

int32_t anc_processor_level(void)
{
    uint32_t r[4], kept, upper; /* kept: the registers that the system saves for each thread */
    ask(0, r);
    if (r[0] < 7) return 1;
    ask(1, r); /* SSE3, SSSE3, FMA, CMPXCHG16B, SSE4.1, SSE4.2, MOVBE, POPCNT, OSXSAVE, AVX, F16C */
    if (!has(r[2], 1u << 0 | 1u << 9 | 1u << 12 | 1u << 13 | 1u << 19 | 1u << 20 | 1u << 22 |
                       1u << 23 | 1u << 27 | 1u << 28 | 1u << 29))
        return 1;
    __asm__("xgetbv" : "=a"(kept), "=d"(upper) : "c"(0));
    ask(0x80000000u, r);
    if (!has(kept, 0x6) || r[0] < 0x80000001u) return 1; /* xmm, ymm */
    ask(0x80000001u, r);                                 /* LAHF, LZCNT */
    if (!has(r[2], 1u << 0 | 1u << 5)) return 1;
    ask(7, r); /* BMI1, AVX2, BMI2 */
    if (!has(r[1], 1u << 3 | 1u << 5 | 1u << 8)) return 1;
    /* AVX-512 F, DQ, CD, BW, VL; xmm, ymm and the three parts of zmm */
    return has(r[1], 1u << 16 | 1u << 17 | 1u << 28 | 1u << 30 | 1u << 31) && has(kept, 0xe6) ? 4
                                                                                              : 3;
}
#else
int32_t anc_processor_level(void) { return 1; }
#endif
