/* The Kalman filter with P = diag(p) (eq. 2 to 9): p += r, S = sum p x'^2 + q, w += p x'/S (alpha d^ - w'x'),
 * p -= (p x')^2/S. */
static int adapt(anc_state *state, double error)
{
    const double *h = state->filtered + state->filtered_start;
    const double d = disturbance_estimate(state, error);
#if POWERS
    const anc_powers next = powers_with(state, d);
    double residual = next.factor * d;
#else
    double residual = constraint_factor * d;
#endif
    double S = measurement_noise;

    if (!isfinite(d * d))
        return ANC_BAD_INPUT;
    for (int32_t i = 0; i < ANC_TAPS; i++) {
        S += (state->variances[i] + state_noise) * h[i] * h[i];
        residual -= state->weights[i] * h[i];
    }
    if (!isfinite(S) || !isfinite(residual))
        return ANC_NO_SOLUTION;
    for (int32_t i = 0; i < ANC_TAPS; i++) {
        state->variances[i] += state_noise; /* eq. 4 */
        if (S > 0.0) { /* otherwise q = 0 and the reference is silent: there is nothing to correct */
            const double gain = state->variances[i] * h[i] / S; /* eq. 6 */
            const double left = 1.0 - gain * h[i];
            state->weights[i] += gain * residual;               /* eq. 5 and 9 */
            state->variances[i] *= left > 0.0 ? left : 0.0;     /* eq. 8; rounding can make it negative */
        }
    }
#if POWERS
    state->powers = next;
#endif
    return ANC_ADAPTED;
}

