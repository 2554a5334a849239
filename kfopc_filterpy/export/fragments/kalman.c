/* The lower triangle of P is stored row by row: P(n|n-1), with eq. 4 applied at the end of the sample before. */

/* Set g = P(n|n-1) h. Row i of the triangle is also column i of the upper one. */
static void project(anc_state *state, const double *h)
{
    const double *row = state->covariance;
    double *g = state->gain_direction;
    for (int32_t i = 0; i < ANC_TAPS; i++) {
        double sum = row[i] * h[i];
        for (int32_t j = 0; j < i; j++) {
            sum += row[j] * h[j];
            g[j] += row[j] * h[i];
        }
        g[i] = sum;
        row += i + 1;
    }
}

/* Apply eq. 8, P(n|n) = P(n|n-1) - g g'/S, and eq. 4 of the next sample, P(n+1|n) = P(n|n) + r I. */
static void downdate(anc_state *state, double S)
{
    const double *g = state->gain_direction;
    const double inverse = 1.0 / S;
    double *row = state->covariance;
    for (int32_t i = 0; i < ANC_TAPS; i++) {
        const double gain = g[i] * inverse;
        for (int32_t j = 0; j <= i; j++)
            row[j] -= gain * g[j];
        row[i] += state_noise;
        row += i + 1;
    }
}

/* Add a b to sum + rest in twice the precision: the products and sums keep what rounding takes from them (Ogita, Rump
 * and Oishi). */
static void add_product(double *sum, double *rest, double a, double b)
{
    const double product = a * b;
    const double product_rest = fma(a, b, -product);
    const double total = *sum + product;
    const double added = total - *sum;
    *rest += product_rest + ((*sum - (total - added)) + (product - added));
    *sum = total;
}

/* Apply eq. 8 and 4 in twice the precision, where S is so large beside q that the difference cancels most digits of P;
 * this happens in the first samples after a large initial variance. Return 0, with P unchanged, if that overflows. */
static int downdate_carefully(anc_state *state, const double *h)
{
    double *g = state->gain_direction, *g_low = state->gain_direction_low;
    double *k = state->gain, *k_low = state->gain_low;
    double *row = state->covariance;
    double S = measurement_noise, S_low = 0.0, S_sum, size;

    for (int32_t i = 0; i < ANC_TAPS; i++) {
        g[i] = 0.0;
        g_low[i] = 0.0;
        for (int32_t j = 0; j < i; j++) {
            add_product(&g[i], &g_low[i], row[j], h[j]);
            add_product(&g[j], &g_low[j], row[j], h[i]);
        }
        add_product(&g[i], &g_low[i], row[i], h[i]);
        row += i + 1;
    }
    for (int32_t i = 0; i < ANC_TAPS; i++) {
        S_low += h[i] * g_low[i];
        add_product(&S, &S_low, h[i], g[i]);
    }
    S_sum = S + S_low;
    S_low -= S_sum - S;
    S = S_sum;
    size = S;
    for (int32_t i = 0; i < ANC_TAPS; i++) { /* eq. 6, K = g/S */
        double product, rest;
        k[i] = g[i] / S;
        product = k[i] * S;
        rest = fma(k[i], S, -product);
        k_low[i] = (((g[i] - product) - rest) + g_low[i] - k[i] * S_low) / S;
        size += fabs(g[i]) + fabs(g_low[i]) + fabs(k[i]) + fabs(k_low[i]);
    }
    if (!(S > 0.0 && size < largest_size))
        return 0;
    row = state->covariance;
    for (int32_t i = 0; i < ANC_TAPS; i++) {
        for (int32_t j = 0; j <= i; j++) {
            const double product = g[i] * k[j];
            const double rest = fma(g[i], k[j], -product);
            row[j] = (row[j] - product) - (rest + (g[i] * k_low[j] + g_low[i] * k[j]));
        }
        row[i] += state_noise;
        row += i + 1;
    }
    return 1;
}

/* Return whether the corrected weights would be finite. */
static int correction_is_finite(const anc_state *state, double step)
{
    double total = 0.0;
    for (int32_t i = 0; i < ANC_TAPS; i++)
        total += fabs(state->weights[i] + state->gain_direction[i] * step);
    return isfinite(total);
}

/* The Kalman filter with the measurement alpha d^ (eq. 2 to 13). Nothing is stored before it is known to be finite. */
static int adapt(anc_state *state, double error)
{
    const double *h = state->filtered + state->filtered_start;
    const double d = disturbance_estimate(state, error);
#if POWERS
    const anc_powers next = powers_with(state, d);
    const double measurement = next.factor * d;
#else
    const double measurement = constraint_factor * d;
#endif
    double S, step;

    if (!isfinite(d * d))
        return ANC_BAD_INPUT;
    project(state, h);
    S = dot(h, state->gain_direction, ANC_TAPS) + measurement_noise; /* x'^T P(n|n-1) x' + q, eq. 6 */
    if (!(S > 0.0 && isfinite(S)))
        return ANC_NO_SOLUTION;
    step = (measurement - dot(h, state->weights, ANC_TAPS)) / S;
    if (!correction_is_finite(state, step))
        return ANC_NO_SOLUTION;
    if (!(S > cancellation * measurement_noise && downdate_carefully(state, h)))
        downdate(state, S);
    for (int32_t i = 0; i < ANC_TAPS; i++) /* eq. 5 and 9, with K = g/S */
        state->weights[i] += state->gain_direction[i] * step;
#if POWERS
    state->powers = next;
#endif
    return ANC_ADAPTED;
}

