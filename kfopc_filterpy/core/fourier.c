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
    f->turns = reals(at, "turns", ANC_STATE, 1, 1, 2, f->F + f->half);
    f->work = reals(at, "transform_work", ANC_SCRATCH, 1, 1, 5, f->F);
}

static const real *cosines(const fourier *f, int32_t m) { return f->turns + m; }
static const real *sines(const fourier *f, int32_t m) { return f->turns + f->F + f->half + m; }

/* Set the cosines and sines by halving angles: square roots are exact on every machine, a library's
 * cosines are not. */
void start_fourier(const fourier *f)
{
    double cosine[32] = {-1, 0}, sine[32] = {0, 1}; /* of pi / 2^e */
    for (int e = 2; e < 32; e++) {
        cosine[e] = sqrt((1 + cosine[e - 1]) / 2);
        sine[e] = sine[e - 1] / (2 * cosine[e]);
    }
    for (int32_t m = 1, e = 0; m <= f->F; m *= 2, e++)
        for (int32_t p = 0; p < m && p < f->half; p++) {
            double c = 1, s = 0;
            for (int bit = 0; p >> bit; bit++) {
                if (!(p >> bit & 1)) continue;
                const double real_part = c * cosine[e - bit] - s * sine[e - bit];
                s = c * sine[e - bit] + s * cosine[e - bit];
                c = real_part;
            }
            f->turns[m + p] = (real)c;
            f->turns[f->F + f->half + m + p] = (real)s;
        }
}

/* Set n sums of four complex numbers that are a quarter apart; sums 0 to 3 are turned by as many
 * times an angle, with the cosine c and the sine d: one for all, or one for `each`. */
static inline void sum_fours(int32_t n, int32_t quarter, const real *restrict c,
                             const real *restrict d, const int each, const real *restrict re,
                             const real *restrict im, real *restrict re0, real *restrict re1,
                             real *restrict re2, real *restrict re3, real *restrict im0,
                             real *restrict im1, real *restrict im2, real *restrict im3)
{
    for (int32_t q = 0, k = quarter; q < n; q++, k++) {
        const real c1 = c[each * q], d1 = d[each * q];
        const real c2 = c1 * c1 - d1 * d1, d2 = 2 * c1 * d1;
        const real c3 = c1 * c2 - d1 * d2, d3 = c1 * d2 + d1 * c2;
        const real even = re[q] + re[k + quarter], apart = re[q] - re[k + quarter];
        const real even_i = im[q] + im[k + quarter], apart_i = im[q] - im[k + quarter];
        const real odd = re[k] + re[k + 2 * quarter], turned_i = re[k + 2 * quarter] - re[k];
        const real odd_i = im[k] + im[k + 2 * quarter], turned = im[k] - im[k + 2 * quarter];
        re0[q] = even + odd;
        im0[q] = even_i + odd_i;
        re1[q] = (apart + turned) * c1 + (apart_i + turned_i) * d1;
        im1[q] = (apart_i + turned_i) * c1 - (apart + turned) * d1;
        re2[q] = (even - odd) * c2 + (even_i - odd_i) * d2;
        im2[q] = (even_i - odd_i) * c2 - (even - odd) * d2;
        re3[q] = (apart - turned) * c3 + (apart_i - turned_i) * d3;
        im3[q] = (apart_i - turned_i) * c3 - (apart - turned) * d3;
    }
}

/* Make a step of Stockham's radix-4 transform from a to b: the same sums s times side by side. */
static void make_step(const fourier *f, const real *a, real *b, int32_t s)
{
    const int32_t H = f->half, quarter = H / 4, m = quarter / s;
    const real *c = cosines(f, 2 * m), *d = sines(f, 2 * m);
    for (int32_t p = 0; p < m; p++) {
        real *re = b + 4 * s * p, *im = re + H;
        sum_fours(s, quarter, c + p, d + p, 0, a + s * p, a + H + s * p, re, re + s, re + 2 * s,
                  re + 3 * s, im, im + s, im + 2 * s, im + 3 * s);
    }
}

/* Set b to n numbers from each of four parts in turn. */
static void interleave(const real *restrict a, real *restrict b, int32_t n)
{
    for (int32_t p = 0; p < n; p++) {
        b[4 * p] = a[p];
        b[4 * p + 1] = a[n + p];
        b[4 * p + 2] = a[2 * n + p];
        b[4 * p + 3] = a[3 * n + p];
    }
}

/* Make the first step from a to a, with one sum of each angle. Compilers use vectors for these
 * loops. */
static void make_first_step(const fourier *f, real *a, real *b)
{
    const int32_t H = f->half, m = H / 4;
    real *im = b + H;
    sum_fours(m, m, cosines(f, 2 * m), sines(f, 2 * m), 1, a, a + H, b, b + m, b + 2 * m, b + 3 * m,
              im, im + m, im + 2 * m, im + 3 * m);
    interleave(b, a, m);
    interleave(im, a + H, m);
}

/* Transform F / 2 complex numbers, real parts first; b is as long. Return which of the two has the
 * result. */
static real *transform_complex(const fourier *f, real *a, real *b)
{
    const int32_t H = f->half;
    int32_t s = H < 4 ? 1 : 4;
    if (s == 4) make_first_step(f, a, b);
    for (; 4 * s <= H; s *= 4) {
        make_step(f, a, b, s);
        real *next = a;
        a = b;
        b = next;
    }
    if (s == H) return a;
    for (int part = 0; part < 2; part++) { /* s is half of H */
        const real *restrict from = a + part * H;
        real *restrict to = b + part * H;
        for (int32_t q = 0; q < s; q++) {
            to[q] = from[q] + from[q + s];
            to[q + s] = from[q] - from[q + s];
        }
    }
    return b;
}

/* At an odd frequency, sample k + F / 2 is turned by a quarter against sample k, and the transform
 * of both halves is one of half the length. */
void transform(const fourier *f, real *spectrum, const real *from, int32_t n)
{
    const int32_t H = f->half;
    real *re = scratch_row(f, 0), *im = re + H;
    const real *restrict c = cosines(f, f->F), *restrict d = sines(f, f->F);
    int32_t k = 0;
    for (; k < n - H; k++) {
        re[k] = from[k] * c[k] - from[H + k] * d[k];
        im[k] = -from[k] * d[k] - from[H + k] * c[k];
    }
    for (; k < n && k < H; k++) {
        re[k] = from[k] * c[k];
        im[k] = -from[k] * d[k];
    }
    for (; k < H; k++) re[k] = im[k] = 0;
    copy(spectrum, transform_complex(f, re, scratch_row(f, 1)), (size_t)f->F);
}

void transform_back(const fourier *f, real *to, const real *spectrum, int32_t n)
{
    const int32_t H = f->half;
    const real scale = 2 / (real)f->F;
    const real *restrict c = cosines(f, f->F), *restrict d = sines(f, f->F);
    real *a = scratch_row(f, 0); /* with its parts exchanged, a transform is the inverse */
    for (int32_t k = 0; k < H; k++) {
        a[k] = spectrum[H + k] * scale;
        a[H + k] = spectrum[k] * scale;
    }
    const real *Z = transform_complex(f, a, scratch_row(f, 1));
    for (int32_t k = 0; k < n && k < H; k++) to[k] = Z[H + k] * c[k] - Z[k] * d[k];
    for (int32_t k = 0; k < n - H; k++) to[H + k] = -Z[H + k] * d[k] - Z[k] * c[k];
}

void transform_rows(const fourier *f, real *spectra, const real *rows, int32_t n, int32_t taps)
{
    for (int32_t i = 0; i < n; i++)
        transform(f, spectra + times(i, f->F), rows + times(i, taps), taps);
}

void transform_rows_back(const fourier *f, real *rows, const real *spectra, int32_t n, int32_t taps)
{
    for (int32_t i = 0; i < n; i++)
        transform_back(f, rows + times(i, taps), spectra + times(i, f->F), taps);
}

void add_lags(const fourier *f, real *to, const real *u, int32_t n, const real *v, int32_t lags)
{
    real *U = scratch_row(f, 2), *V = scratch_row(f, 3), *sums = scratch_row(f, 4);
    for (int32_t first = 0; first < lags; first += f->half) {
        const int32_t now = lags - first < f->half ? lags - first : f->half, part = f->F - now + 1;
        clear(sums, (size_t)f->F);
        for (int32_t begin = 0; begin < n; begin += part) {
            const int32_t count = n - begin < part ? n - begin : part;
            transform(f, U, u + begin, count);
            transform(f, V, v + first + begin, count + now - 1);
            add_product(f, sums, U, V, 1, -1);
        }
        transform_back(f, U, sums, now);
        add_scaled(to + first, 1, U, now);
    }
}

void add_all_lags(const fourier *f, real *to, const real *u, int32_t C, int32_t row, int32_t n,
                  int32_t lags)
{
    for (int32_t a = 0; a < C; a++)
        for (int32_t c = 0; c < C; c++)
            add_lags(f, to + times(a * C + c, lags), u + times(a, row), n, u + times(c, row), lags);
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
        lags[f->F - l] = -behind[l] * share;
    }
    transform(f, spectrum, lags, f->F);
}

static void scale_spectrum(const fourier *f, real *restrict x, const real *restrict by)
{
    for (int32_t k = 0; k < f->half; k++) x[k] *= by[k];
    for (int32_t k = 0; k < f->half; k++) x[f->half + k] *= by[k];
}

void transform_all_lags(const fourier *f, real *A, const real *lags, int32_t C, int32_t N,
                        int32_t n, int smooth)
{
    for (int32_t a = 0; a < C; a++)
        for (int32_t c = 0; c < C; c++)
            transform_lags(f, A + times(a * C + c, f->F), lags + times(c * C + a, N),
                           lags + times(a * C + c, N), n, smooth);
}

void multiply_rows(const fourier *f, real *to, const real *A, const real *x, int32_t rows,
                   int32_t n)
{
    const size_t each = (size_t)f->F;
    clear(to, times(rows, f->F));
    for (int32_t a = 0; a < rows; a++, to += each)
        for (int32_t c = 0; c < n; c++, A += each)
            add_product(f, to, A, x + (size_t)c * each, 1, 1);
}

void factorise_spectra(const fourier *f, real *A, int32_t n)
{
    const size_t each = (size_t)f->F;
    real *least = scratch_row(f, 2);
    for (int32_t i = 0; i < n; i++) {
        real *row = A + times(i, n) * each, *diagonal = row + (size_t)i * each;
        for (int32_t k = 0; k < f->half; k++) least[k] = SINGULAR * diagonal[k];
        for (int32_t c = 0; c <= i; c++) {
            real *at = row + (size_t)c * each;
            const real *other = A + times(c, n) * each;
            for (int32_t k = 0; k < c; k++)
                add_product(f, at, other + (size_t)k * each, row + (size_t)k * each, -1, -1);
            if (c < i) scale_spectrum(f, at, other + (size_t)c * each);
        }
        for (int32_t k = 0; k < f->half; k++)
            diagonal[k] = diagonal[k] > least[k] ? 1 / root(diagonal[k]) : 0;
    }
}

void solve_spectra(const fourier *f, const real *factor, real *x, int32_t n)
{
    const size_t each = (size_t)f->F;
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
    transform_rows(f, spectra, r, n, taps);
    solve_spectra(f, factor, spectra, n);
    transform_rows_back(f, to, spectra, n, taps);
}

void approach(const equations *of, const real *b, real *v, int steps)
{
    const int32_t n = of->n;
    real *restrict r = of->work, *p = r + n, *z = p + n, *product = z + n;
    of->multiply(of->self, product, v);
    for (int32_t i = 0; i < n; i++) r[i] = b[i] - product[i];
    of->precondition(of->self, p, r);
    real energy = dot(r, p, n);
    for (int step = 0; step < steps && energy > 0; step++) {
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
