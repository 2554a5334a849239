/* MOV-FxLMS: w(n+1) = w(n) + mu [e(n) x'(n) - gamma y(n) x(n)]. */
static int adapt(anc_state *state, double error)
{
    const double *reference = state->reference + state->reference_start;
    const double *filtered = state->filtered + state->filtered_start;
    const double y = state->output[state->output_start];
    const double d = disturbance_estimate(state, error);
    double correction, penalty;

    if (!isfinite(d * d))
        return ANC_BAD_INPUT;
#if POWERS
    state->powers = powers_with(state, d);
    penalty = 0.0; /* gamma = G_s (1/alpha - 1) */
    if (state->powers.factor < 1.0 && state->powers.gain > 0.0)
        penalty = state->powers.gain * (1.0 / state->powers.factor - 1.0);
#else
    penalty = penalty_factor;
#endif
#if MODIFIED
    error = d - dot(state->weights, filtered, ANC_TAPS); /* the modified structure */
#endif
    correction = step_size * error;
    penalty = step_size * penalty * y;
    for (int32_t i = 0; i < ANC_TAPS; i++)
        state->weights[i] += correction * filtered[i] - penalty * reference[i];
    return ANC_ADAPTED;
}

