/* The fast array: the gains of a Kalman filter without state noise, with or without forgetting, in O(L) per
 * sample, for one channel.
 *
 * P, in units of the measurement noise, changes by a matrix of rank two when the row x' shifts by a sample:
 *
 *     ([P(n), 0; 0, 0] - [0, 0; 0, P(n-1)]) / lambda = B(n) diag(1, -1) B(n)^T
 *
 * One orthogonal and one hyperbolic rotation, together Theta, zero the second and third entry of the first row below.
 * They update the gain g, gamma^-1(n) = 1 + x'^T(n) P(n-1) x'(n) / lambda and B. x+ has the L + 1 newest samples.
 *
 *     [gamma^-1/2(n),             x+^T(n+1) B(n)]         [gamma^-1/2(n+1),                 0              ]
 *     [[0; g(n) gamma^-1/2(n)],   B(n)          ] Theta = [[g(n+1) gamma^-1/2(n+1); 0],  lambda^1/2 B(n+1)]
 *
 * The docstring of FastArrayKalman derives this, and says what rounding does.
 *
 * R. Fraanje, A. H. Sayed, M. Verhaegen, N. J. Doelman, "A fast-array Kalman filter solution to active noise control",
 * Int. J. Adapt. Control Signal Process. 19, 2005; A. H. Sayed, Fundamentals of Adaptive Filtering, Wiley 2003,
 * ch. 14. */
#include "signals.h"
#include <string.h>

typedef struct { /* of an array */
    real root;    /* gamma^-1/2; 0: rounding or a sample that was too loud has corrupted the array */
    real energy;  /* squared norm of the gain column */
    real heard;   /* samples since the start */
    real trusted; /* samples at the start that leave the weights as they are */
} array_numbers;

typedef struct { /* of the two arrays of a finite memory */
    real elder;      /* which of them it is */
    real paired;     /* 1: the younger one runs */
    real elder_lost; /* 1: the elder one stands still until the younger one has taken over */
    real initial;    /* P at the next start */
    real lost;       /* arrays lost to rounding so far */
} turns;

typedef struct {
    signals s;
    real *gain;             /* (n, L + 1) g gamma^-1/2, and a last entry that is zero but for rounding; n is 1 or 2 */
    real *first, *second;   /* (n, L + 1) the columns of B */
    int32_t n;
    real *weights;          /* (S, n, L) */
    array_numbers *numbers; /* (n) */
    turns *turns;
} arrays;

typedef struct { real root, c, s, t, h; } rotations; /* next gamma^-1/2; orthogonal: cosine, sine; hyperbolic: tangent, cosine */

enum { MEASUREMENT_NOISE, INITIAL_VARIANCE, FORGETTING, MEMORY = FORGETTING };
static const anc_setting growing_settings[] = {
    {"measurement_noise", FLT_MIN, MOST_VARIANCE, ANC_ONE}, {"initial_variance", FLT_MIN, MOST_VARIANCE, ANC_ONE}, {"forgetting", FLT_MIN, 1, ANC_ONE}, {0}};
static const anc_setting finite_settings[] = { /* float counts to 2^24, twice the memory */
    {"measurement_noise", FLT_MIN, MOST_VARIANCE, ANC_ONE}, {"initial_variance", FLT_MIN, MOST_VARIANCE, ANC_ONE}, {"memory", 2, 1 << 23, ANC_ONE}, {0}};

/* An array is lost if the last entry of its gain column exceeds UNUSABLE of the column's norm. One of a pair, which can
 * be restarted, is given up beyond ASTRAY. */
static const real UNUSABLE = (real)0.1, ASTRAY = (real)1e-4;
static const real LESS = (real)0.01, MORE = 2; /* of P at the next start: after an array was lost, and after one lasted */

static void layout_arrays(arrays *f, const anc_plan *plan, const anc_setting *settings, anc_layout *at, int32_t n)
{
    signals *s = &f->s;
    layout_signals(s, plan, settings, at);
    f->n = n;
    f->gain = reals(at, "gain", ANC_STATE, 1, 1, n, s->L + 1);
    f->first = reals(at, "first_column", ANC_STATE, 1, 1, n, s->L + 1);
    f->second = reals(at, "second_column", ANC_STATE, 1, 1, n, s->L + 1);
    f->numbers = (array_numbers *)reals(at, "arrays", ANC_STATE, 1, 1, n, COLUMNS(array_numbers));
}

/* P(-1) in units of the measurement noise. */
static real initial_variance(const signals *s) { return *s->setting[INITIAL_VARIANCE] / *s->setting[MEASUREMENT_NOISE]; }

/* Begin array i with P = initial I: the row's samples so far count as zeros. */
static void begin(arrays *f, int32_t i, real initial, int32_t trusted)
{
    const int32_t n = f->s.L + 1;
    real *columns[] = {f->gain + times(i, n), f->first + times(i, n), f->second + times(i, n)};
    for (int c = 0; c < 3; c++) memset(columns[c], 0, sizeof(real) * (size_t)n);
    columns[1][0] = columns[2][n - 1] = root(initial);
    f->numbers[i] = (array_numbers){.root = 1, .trusted = (real)trusted};
}

/* Set the rotations for the newest row; return 0 if they do not exist, because rounding has corrupted the array. */
static int find_rotations(const arrays *f, int32_t i, real largest_stray, rotations *r)
{
    const int32_t n = f->s.L + 1;
    const array_numbers *a = f->numbers + i;
    const int32_t known = a->heard + 1 < (real)n ? (int32_t)a->heard + 1 : n; /* before its start: zeros */
    const real *row = newest(&f->s.filtered, 0), last = f->gain[times(i, n) + (size_t)f->s.L];
    const real ahead = dot(row, f->first + times(i, n), known), behind = dot(row, f->second + times(i, n), known);
    const real next = root(a->root * a->root + ahead * ahead), t = behind / next, cosine = root(1 - t * t);
    *r = (rotations){.root = next * cosine, .c = a->root / next, .s = ahead / next, .t = t, .h = 1 / cosine};
    return a->root > 0 && last * last <= largest_stray * largest_stray * a->energy && cosine > 0 && isfinite(next);
}

static void rotate(arrays *f, int32_t i, rotations r, real forgetting)
{
    const int32_t n = f->s.L + 1;
    real *restrict gain = f->gain + times(i, n), *restrict first = f->first + times(i, n), *restrict second = f->second + times(i, n);
    const real grow = 1 / root(forgetting), both = r.h * grow;
    memmove(gain + 1, gain, sizeof(real) * (size_t)(n - 1));
    gain[0] = 0;
    for (int32_t l = 0; l < n; l++) {
        const real rotated = r.c * gain[l] + r.s * first[l];
        first[l] = grow * (r.c * first[l] - r.s * gain[l]);
        gain[l] = r.h * (rotated - r.t * second[l]);
        second[l] = both * (second[l] - r.t * rotated);
    }
    f->numbers[i].root = r.root;
    f->numbers[i].energy = dot(gain, gain, n);
    f->numbers[i].heard += 1;
}

/* Follow the newest row. An array must hear every sample of the reference, whatever becomes of its error. */
static void advance_array(arrays *f, int32_t i, real largest_stray, real forgetting)
{
    rotations r;
    if (find_rotations(f, i, largest_stray, &r)) rotate(f, i, r, forgetting);
    else f->numbers[i].root = 0;
}

static real *weights_in(const arrays *f, int32_t scenario, int32_t i) { return f->weights + times(scenario * f->n + i, f->s.L); }

/* w += g (alpha d^ - w'x'), with the gain of an array that was rotated for this row. */
static void correct_array(arrays *f, int32_t i)
{
    const signals *s = &f->s;
    const array_numbers *a = f->numbers + i;
    if (a->heard <= a->trusted) return;
    for (int32_t scenario = 0; scenario < s->S; scenario++) {
        real *w = weights_in(f, scenario, i);
        const real step = (s->previewed[scenario].factor * s->estimate[scenario] - dot(w, newest(&s->filtered, 0), s->L)) / a->root;
        if (within(step * root(a->energy), LARGEST)) add_scaled(w, step, f->gain + times(i, s->L + 1), s->L);
    }
}

/* A growing memory, with forgetting. The gains must follow the row from the first sample on, so it also adapts while it
 * listens. */

static void layout_growing(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at)
{
    arrays *f = (arrays *)view;
    layout_arrays(f, plan, settings, at, 1);
    f->weights = f->s.weights;
}

static void begin_growing(arrays *f, int32_t trusted)
{
    real fade = 1; /* lambda^L */
    begin(f, 0, initial_variance(&f->s), trusted);
    for (int32_t l = 0; l < f->s.L; l++) fade *= *f->s.setting[FORGETTING];
    f->second[f->s.L] *= root(fade);
}

static void start_growing(anc_view *view, const anc_plan *plan, const anc_setting *settings)
{
    arrays *f = (arrays *)view;
    start_signals(&f->s, plan, settings);
    begin_growing(f, 0);
}

/* An array that was lost begins again at the weights, as one of a pair does. */
static void advance_growing(arrays *f)
{
    if (f->numbers->root == 0) begin_growing(f, f->s.L - 1);
    advance_array(f, 0, UNUSABLE, *f->s.setting[FORGETTING]);
}

static int control_signal_growing(anc_view *view, const real *reference, real *control)
{
    const int refused = filtered_signal(view, reference, control);
    if (!refused) advance_growing((arrays *)view);
    return refused;
}

static int update_growing(anc_view *view, const real *error)
{
    arrays *f = (arrays *)view;
    const int refused = error ? estimate(&f->s, error) : ANC_DONE;
    if (!error || refused) return refused;
    if (f->numbers->root == 0) return ANC_LOST_ARRAY;
    correct_array(f, 0);
    commit(&f->s);
    return ANC_DONE;
}

static int listen_growing(anc_view *view, const real *error)
{
    advance_growing((arrays *)view);
    return update_growing(view, error);
}

const anc_algorithm anc_fast_array = {"fast-array KF", growing_settings, layout_growing, start_growing, control_signal_growing, update_growing, listen_growing};

/* A finite memory of N samples: two growing ones without forgetting that take turns.
 *
 * The younger one starts when the elder one has heard N samples, and takes over after N more, when the elder one is
 * restarted. Its share of the mixed weights grows with the number a of samples that it has heard, a/N. If the
 * reference's statistics are steady, the variance of the mixed weights is then that of least squares over N samples, at
 * every sample: with shares s = a/N and 1 - s of filters that average over a and a + N samples, it is proportional to
 * a (s/a + (1 - s)/(a + N))^2 + N ((1 - s)/(a + N))^2 = 1/N. */

static void layout_finite(anc_view *view, const anc_plan *plan, const anc_setting *settings, anc_layout *at)
{
    arrays *f = (arrays *)view;
    layout_arrays(f, plan, settings, at, 2);
    f->weights = reals(at, "array_weights", ANC_STATE, f->s.S, 1, 2, f->s.L);
    f->turns = (turns *)reals(at, "turns", ANC_STATE, 1, 1, 1, COLUMNS(turns));
}

static void start_finite(anc_view *view, const anc_plan *plan, const anc_setting *settings)
{
    arrays *f = (arrays *)view;
    start_signals(&f->s, plan, settings);
    f->turns->initial = initial_variance(&f->s);
    for (int32_t i = 0; i < 2; i++) begin(f, i, f->turns->initial, 0);
}

/* Begin array i at known weights: those of the elder array, or the mixed ones. The first L - 1 rows are incomplete, so
 * the measurements do not fit them. They count as measurements that the weights explain, so that P is complete when the
 * first full row is due. */
static void restart(arrays *f, int32_t i, int mixed)
{
    for (int32_t scenario = 0; scenario < f->s.S; scenario++) {
        const real *weights = mixed ? weights_of(&f->s, scenario) : weights_in(f, scenario, (int32_t)f->turns->elder);
        real *own = weights_in(f, scenario, i);
        if (own != weights) memcpy(own, weights, sizeof(real) * (size_t)f->s.L);
    }
    begin(f, i, f->turns->initial, f->s.L - 1);
}

/* Correct both arrays, mix their weights, and let them take turns. */
static void correct_pair(arrays *f)
{
    turns *turn = f->turns;
    const int32_t elder = (int32_t)turn->elder, younger = 1 - elder, L = f->s.L;
    const real memory = *f->s.setting[MEMORY], largest = initial_variance(&f->s);
    if (turn->elder_lost == 0) {
        if (f->numbers[elder].root > 0) correct_array(f, elder);
        else if (turn->lost += 1, turn->paired != 0) turn->elder_lost = 1;
        else turn->initial *= LESS, restart(f, elder, 0);
    }
    if (turn->paired != 0) {
        if (f->numbers[younger].root > 0) correct_array(f, younger);
        else turn->lost += 1, turn->initial *= LESS, restart(f, younger, 0);
    }
    real share = turn->paired != 0 ? f->numbers[younger].heard / memory : 0;
    if (share > 1) share = 1; /* samples without adaptation are heard too */
    for (int32_t scenario = 0; scenario < f->s.S; scenario++) {
        const real *w_elder = weights_in(f, scenario, elder), *w_younger = weights_in(f, scenario, younger);
        real *restrict mixed = weights_of(&f->s, scenario);
        for (int32_t l = 0; l < L; l++) mixed[l] = w_elder[l] + share * (w_younger[l] - w_elder[l]);
    }
    if (share == 1) {
        turn->elder = (real)younger, turn->elder_lost = 0;
        turn->initial = MORE * turn->initial < largest ? MORE * turn->initial : largest;
        restart(f, elder, 1);
    } else if (turn->paired == 0 && f->numbers[elder].heard >= memory) {
        turn->paired = 1;
        restart(f, younger, 1);
    }
}

static void advance_pair(arrays *f)
{
    for (int32_t i = 0; i < 2; i++)
        if (f->turns->paired != 0 || i == (int32_t)f->turns->elder) advance_array(f, i, ASTRAY, 1);
}

static int control_signal_finite(anc_view *view, const real *reference, real *control)
{
    const int refused = filtered_signal(view, reference, control);
    if (!refused) advance_pair((arrays *)view);
    return refused;
}

static int update_finite(anc_view *view, const real *error)
{
    arrays *f = (arrays *)view;
    const int refused = error ? estimate(&f->s, error) : ANC_DONE;
    if (!error || refused) return refused;
    correct_pair(f);
    commit(&f->s);
    return ANC_DONE;
}

static int listen_finite(anc_view *view, const real *error)
{
    advance_pair((arrays *)view);
    return update_finite(view, error);
}

const anc_algorithm anc_finite_memory = {"finite-memory fast-array KF", finite_settings, layout_finite, start_finite, control_signal_finite, update_finite, listen_finite};
