/* FxLMS: w(n+1) = w(n) + mu e(n) x'(n). */
static int adapt(anc_state *state, double error)
{
    const double *filtered = state->filtered + state->filtered_start;
    const double correction = step_size * error;
    for (int32_t i = 0; i < ANC_TAPS; i++)
        state->weights[i] += correction * filtered[i];
    return ANC_ADAPTED;
}

