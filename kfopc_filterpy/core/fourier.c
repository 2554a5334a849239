#include "fourier.h"

/* A pivot below this share of the diagonal is rounding. */
#ifdef ANC_FLOAT
static const real SINGULAR = 1e-6f;
#else
static const real SINGULAR = 1e-14;
#endif

void layout_fourier(fourier *f, int32_t N, anc_layout *at)
{
    f->F = 2;
    while (f->F < 2 * N) f->F *= 2;
    f->half = f->F / 2;
    f->bins = f->half + 1;
    f->spectrum = 2 * f->bins;
    f->turns = reals(at, "turns", ANC_STATE, 1, 1, 2, f->F);
    f->work = reals(at, "transform_work", ANC_SCRATCH, 1, 1, 5, f->F + 2);
}

/* Set the cosines and sines by halving angles: square roots are exact on every machine, a library's
 * cosines are not. */
void start_fourier(const fourier *f)
{
    double cosine[32] = {-1, 0}, sine[32] = {0, 1}; /* of pi / 2^e */
    for (int e = 2; e < 32; e++) {
        cosine[e] = sqrt((1 + cosine[e - 1]) / 2);
        sine[e] = sine[e - 1] / (2 * cosine[e]);
    }
    for (int32_t m = 1, e = 0; m <= f->half; m *= 2, e++)
        for (int32_t p = 0; p < m; p++) {
            double c = 1, s = 0;
            for (int bit = 0; p >> bit; bit++) {
                if (!(p >> bit & 1)) continue;
                const double real_part = c * cosine[e - bit] - s * sine[e - bit];
                s = c * sine[e - bit] + s * cosine[e - bit];
                c = real_part;
            }
            f->turns[m + p] = (real)c;
            f->turns[f->F + m + p] = (real)s;
        }
}

/* Set the sums of n times four elements, a quarter apart: 0, 1, 2 and 3 are turned by as many times
 * the angle (c, d). */
static inline void turn(int32_t n, real c, real d, const real *restrict re, const real *restrict im,
                        int32_t quarter, real *restrict re0, real *restrict re1, real *restrict re2,
                        real *restrict re3, real *restrict im0, real *restrict im1,
                        real *restrict im2, real *restrict im3)
{
    const real c2 = c * c - d * d, d2 = 2 * c * d, c3 = c * c2 - d * d2, d3 = c * d2 + d * c2;
    for (int32_t q = 0, k = quarter; q < n; q++, k++) {
        const real even = re[q] + re[k + quarter], apart = re[q] - re[k + quarter];
        const real even_i = im[q] + im[k + quarter], apart_i = im[q] - im[k + quarter];
        const real odd = re[k] + re[k + 2 * quarter], turned_i = re[k + 2 * quarter] - re[k];
        const real odd_i = im[k] + im[k + 2 * quarter], turned = im[k] - im[k + 2 * quarter];
        re0[q] = even + odd;
        im0[q] = even_i + odd_i;
        re1[q] = (apart + turned) * c + (apart_i + turned_i) * d;
        im1[q] = (apart_i + turned_i) * c - (apart + turned) * d;
        re2[q] = (even - odd) * c2 + (even_i - odd_i) * d2;
        im2[q] = (even_i - odd_i) * c2 - (even - odd) * d2;
        re3[q] = (apart - turned) * c3 + (apart_i - turned_i) * d3;
        im3[q] = (apart_i - turned_i) * c3 - (apart - turned) * d3;
    }
}

/* Make a step of Stockham's radix-4 transform, over p < m. */
static void make_step(const fourier *f, const real *restrict a, real *restrict b, int32_t m,
                      int32_t s)
{
    const int32_t H = f->half;
    const real *restrict c = f->turns + 2 * m, *restrict d = f->turns + f->F + 2 * m;
    for (int32_t p = 0; p < m; p++) {
        real *re = b + 4 * s * p, *im = re + H;
        turn(s, c[p], d[p], a + s * p, a + H + s * p, s * m, re, re + s, re + 2 * s, re + 3 * s, im,
             im + s, im + 2 * s, im + 3 * s);
    }
}

/* Transform F / 2 complex numbers, real parts first; b is as long. Return which of the two has the
 * result. */
static real *transform_complex(const fourier *f, real *a, real *b)
{
    const int32_t H = f->half;
    int32_t s = 1;
    for (; 4 * s <= H; s *= 4) {
        make_step(f, a, b, H / (4 * s), s);
        real *next = a;
        a = b;
        b = next;
    }
    if (s == H) return a;
    for (int32_t q = 0; q < s; q++) { /* s is half of H */
        b[q] = a[q] + a[q + s];
        b[q + s] = a[q] - a[q + s];
        b[H + q] = a[H + q] + a[H + q + s];
        b[H + q + s] = a[H + q] - a[H + q + s];
    }
    return b;
}

/* Even samples are the real parts of a transform of half the length, odd ones its imaginary parts.
 */
void transform(const fourier *f, real *spectrum, const real *from, int32_t n)
{
    const int32_t H = f->half;
    real *a = scratch_row(f, 0), *restrict re = spectrum, *restrict im = spectrum + f->bins;
    for (int32_t k = 0; k < H; k++) {
        a[k] = 2 * k < n ? from[2 * k] : 0;
        a[H + k] = 2 * k + 1 < n ? from[2 * k + 1] : 0;
    }
    const real *restrict Z = transform_complex(f, a, scratch_row(f, 1));
    const real *restrict c = f->turns + H, *restrict d = f->turns + f->F + H;
    re[0] = Z[0] + Z[H];
    re[H] = Z[0] - Z[H];
    im[0] = im[H] = 0;
    for (int32_t k = 1; k < H; k++) {
        const real even = Z[k] + Z[H - k], odd = Z[H + k] + Z[2 * H - k];
        const real even_i = Z[H + k] - Z[2 * H - k], odd_i = Z[H - k] - Z[k];
        re[k] = (even + (odd * c[k] + odd_i * d[k])) / 2;
        im[k] = (even_i + (odd_i * c[k] - odd * d[k])) / 2;
    }
}

void transform_back(const fourier *f, real *to, const real *spectrum)
{
    const int32_t H = f->half;
    const real scale = 1 / (real)f->F, *restrict re = spectrum, *restrict im = spectrum + f->bins;
    const real *restrict c = f->turns + H, *restrict d = f->turns + f->F + H;
    real *restrict a =
        scratch_row(f, 0); /* with the parts exchanged, the transform is the inverse */
    a[0] = (re[0] - re[H]) * scale;
    a[H] = (re[0] + re[H]) * scale;
    for (int32_t k = 1; k < H; k++) {
        const real x = re[k] - re[H - k], y = im[k] + im[H - k];
        a[H + k] = (re[k] + re[H - k] - (x * d[k] + y * c[k])) * scale;
        a[k] = (im[k] - im[H - k] + (x * c[k] - y * d[k])) * scale;
    }
    const real *Z = transform_complex(f, a, scratch_row(f, 1));
    for (int32_t k = 0; k < H; k++) {
        to[2 * k] = Z[H + k];
        to[2 * k + 1] = Z[k];
    }
}

void add_lags(const fourier *f, real *to, const real *u, int32_t n, const real *v, int32_t lags)
{
    real *U = scratch_row(f, 2), *V = scratch_row(f, 3), *sums = scratch_row(f, 4);
    const int32_t part = f->F - lags + 1;
    clear(sums, (size_t)f->spectrum);
    for (int32_t begin = 0; begin < n; begin += part) {
        const int32_t count = n - begin < part ? n - begin : part;
        transform(f, U, u + begin, count);
        transform(f, V, v + begin, count + lags - 1);
        add_product(f, sums, U, V, 1, -1);
    }
    transform_back(f, U, sums);
    for (int32_t l = 0; l < lags; l++) to[l] += U[l];
}

void transform_lags(const fourier *f, real *spectrum, const real *ahead, const real *behind,
                    int32_t n, int smooth)
{
    real *lags = scratch_row(f, 2);
    clear(lags, (size_t)f->F);
    lags[0] = ahead[0];
    for (int32_t l = 1; l < n; l++) {
        const real share = smooth ? (real)(n - l) / (real)n : 1;
        lags[l] = ahead[l] * share;
        lags[f->F - l] = behind[l] * share;
    }
    transform(f, spectrum, lags, f->F);
}

void factorise_spectra(const fourier *f, real *A, int32_t n)
{
    const size_t each = (size_t)f->spectrum;
    real *least = scratch_row(f, 2);
    for (int32_t i = 0; i < n; i++) {
        real *row = A + times(i, n) * each, *restrict diagonal = row + (size_t)i * each;
        for (int32_t k = 0; k < f->bins; k++) least[k] = SINGULAR * diagonal[k];
        for (int32_t c = 0; c <= i; c++) {
            real *at = row + (size_t)c * each;
            const real *other = A + times(c, n) * each;
            for (int32_t k = 0; k < c; k++)
                add_product(f, at, other + (size_t)k * each, row + (size_t)k * each, -1, -1);
            if (c == i) continue;
            const real *restrict inverse = other + (size_t)c * each;
            for (int32_t k = 0; k < f->bins; k++) at[k] *= inverse[k];
            for (int32_t k = 0; k < f->bins; k++) at[f->bins + k] *= inverse[k];
        }
        for (int32_t k = 0; k < f->bins; k++)
            diagonal[k] = diagonal[k] > least[k] ? 1 / root(diagonal[k]) : 0;
    }
}

static void scale_spectrum(const fourier *f, real *restrict x, const real *restrict by)
{
    for (int32_t k = 0; k < f->bins; k++) x[k] *= by[k];
    for (int32_t k = 0; k < f->bins; k++) x[f->bins + k] *= by[k];
}

void solve_spectra(const fourier *f, const real *factor, real *x, int32_t n)
{
    const size_t each = (size_t)f->spectrum;
    for (int32_t i = 0; i < n; i++) {
        for (int32_t k = 0; k < i; k++)
            add_product(f, x + (size_t)i * each, factor + (times(i, n) + (size_t)k) * each,
                        x + (size_t)k * each, -1, 1);
        scale_spectrum(f, x + (size_t)i * each, factor + (times(i, n) + (size_t)i) * each);
    }
    for (int32_t i = n - 1; i >= 0; i--) {
        for (int32_t k = i + 1; k < n; k++)
            add_product(f, x + (size_t)i * each, factor + (times(k, n) + (size_t)i) * each,
                        x + (size_t)k * each, -1, -1);
        scale_spectrum(f, x + (size_t)i * each, factor + (times(i, n) + (size_t)i) * each);
    }
}

void solve_circulants(const fourier *f, const real *factor, real *spectra, real *to, const real *r,
                      int32_t n, int32_t taps)
{
    real *part = scratch_row(f, 2);
    for (int32_t i = 0; i < n; i++)
        transform(f, spectra + times(i, f->spectrum), r + times(i, taps), taps);
    solve_spectra(f, factor, spectra, n);
    for (int32_t i = 0; i < n; i++) {
        transform_back(f, part, spectra + times(i, f->spectrum));
        copy(to + times(i, taps), part, (size_t)taps);
    }
}

void approach(const equations *of, const real *b, real *v, int steps, real enough)
{
    const int32_t n = of->n;
    real *restrict r = of->work, *p = r + n, *z = p + n, *product = z + n;
    of->multiply(of->self, product, v);
    for (int32_t i = 0; i < n; i++) r[i] = b[i] - product[i];
    of->precondition(of->self, p, r);
    real energy = dot(r, p, n);
    for (int step = 0; step < steps && energy > enough; step++) {
        of->multiply(of->self, product, p);
        const real bend = dot(p, product, n), a = bend > 0 ? energy / bend : 0;
        add_scaled(v, a, p, n);
        add_scaled(r, -a, product, n);
        of->precondition(of->self, z, r);
        const real next = dot(r, z, n), share = next / energy;
        for (int32_t i = 0; i < n; i++) p[i] = z[i] + share * p[i];
        energy = next;
    }
}
