/* Fourier transforms of real numbers, and what can be done with them: sums of products at all lags,
 * and systems of Toeplitz equations whose lags are of both signs. F, a power of two, holds 2N of
 * them. The frequencies are odd multiples of pi / F: (4 j + 1) pi / F, j < F / 2; their
 * conjugates are the other odd multiples. A spectrum is F / 2 real parts, and after them as many
 * imaginary ones. What wraps around in a product changes its sign, so circulants are skew. */
#ifndef FOURIER_H
#define FOURIER_H
#include "signals.h"

typedef struct {
    int32_t F, half; /* reals of a spectrum; F / 2 */
    real *turns;     /* (2, F + F / 2) cosines and sines of pi p / m at m + p */
    real *work;      /* (5, F) of a transform, and of sums at lags */
} fourier;

/* Return a row of the scratch memory. Transforms use the first two, a factorisation the third, sums
 * at lags all five. */
static inline real *scratch_row(const fourier *f, int32_t row)
{
    return f->work + times(row, f->F);
}
/* Lay out transforms for the lags of N taps. */
void layout_fourier(fourier *f, int32_t N, anc_layout *at);
void start_fourier(const fourier *f);
/* Transform n <= F numbers, with zeros after them. */
void transform(const fourier *f, real *spectrum, const real *from, int32_t n);
/* Set `to` to the first n of the F numbers of a spectrum; n <= F. */
void transform_back(const fourier *f, real *to, const real *spectrum, int32_t n);
/* The same for n rows of `taps` numbers. */
void transform_rows(const fourier *f, real *spectra, const real *rows, int32_t n, int32_t taps);
void transform_rows_back(const fourier *f, real *rows, const real *spectra, int32_t n,
                         int32_t taps);
/* Add sum_k u(k) v(k + l), k < n, to to_l, l < lags; v has n + lags - 1 numbers. */
void add_lags(const fourier *f, real *to, const real *u, int32_t n, const real *v, int32_t lags);
/* The same for each of C rows of u with each, and itself; `to` is (C, C, lags). */
void add_all_lags(const fourier *f, real *to, const real *u, int32_t C, int32_t row, int32_t n,
                  int32_t lags);
/* Set a spectrum to that of ahead_l at lags l and behind_l at lags -l, l < n, under a triangle that
 * ends at lag n if `smooth`: then a definite Toeplitz matrix gives a definite circulant near to it,
 * as that of T. Chan, SIAM J. Sci. Stat. Comput. 9 (1988) 766. */
void transform_lags(const fourier *f, real *spectrum, const real *ahead, const real *behind,
                    int32_t n, int smooth);

/* Matrices of n by n spectra, one row after the other. */

/* Add the product of two spectra, times a sign; a is conjugate if `turn` is -1. */
static inline void add_product(const fourier *f, real *restrict to, const real *restrict a,
                               const real *restrict b, const real sign, const real turn)
{
    const int32_t n = f->half;
    for (int32_t k = 0; k < n; k++) {
        to[k] += sign * (a[k] * b[k] - turn * a[n + k] * b[n + k]);
        to[n + k] += sign * (a[k] * b[n + k] + turn * a[n + k] * b[k]);
    }
}

/* Set a matrix to the spectra of n of the N lags of each pair of signals, (C, C, N). */
void transform_all_lags(const fourier *f, real *A, const real *lags, int32_t C, int32_t N,
                        int32_t n, int smooth);
/* Add white noise of this power to a spectrum. */
static inline void add_white(const fourier *f, real *spectrum, real power)
{
    for (int32_t k = 0; k < f->half; k++) spectrum[k] += power;
}
/* Set `to` to a matrix, (rows, n), times n spectra x; `to` is not x. */
void multiply_rows(const fourier *f, real *to, const real *A, const real *x, int32_t rows,
                   int32_t n);
/* Factorise the lower triangle of a Hermitian matrix in place, at each frequency; the diagonal
 * becomes 1 / the factor's. Where it is singular, but for rounding, that is 0. */
void factorise_spectra(const fourier *f, real *A, int32_t n);
/* Solve for the right side x, n spectra, in place. */
void solve_spectra(const fourier *f, const real *factor, real *x, int32_t n);
/* Solve for the right side r, n rows of taps, with the factor of circulants; the first taps of the
 * solution are `to`. The spectra, n, are overwritten. */
void solve_circulants(const fourier *f, const real *factor, real *spectra, real *to, const real *r,
                      int32_t n, int32_t taps);

/* Equations A v = b of n numbers, and approximate ones that are solved at once. */
typedef struct {
    void *self;
    void (*multiply)(void *self, real *to, const real *v);     /* to = A v */
    void (*precondition)(void *self, real *to, const real *r); /* to = about A^-1 r */
    int32_t n;
    real *work; /* (4, n) */
} equations;

/* Take steps of conjugate gradients from v on. */
void approach(const equations *of, const real *b, real *v, int steps);
#endif
