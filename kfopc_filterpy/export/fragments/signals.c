/* Put a sample in front of a delay line of n samples and return the place at which the line now begins. Each sample is
 * stored twice, n places apart, so the newest n samples always stand in one piece, newest first. */
static int32_t push(double *line, int32_t start, int32_t n, double sample)
{
    start = (start > 0 ? start : n) - 1;
    line[start] = sample;
    line[start + n] = sample;
    return start;
}

static double dot(const double *a, const double *b, int32_t n)
{
    double sum = 0.0;
    for (int32_t i = 0; i < n; i++)
        sum += a[i] * b[i];
    return sum;
}

/* Take x(n) and x'(n) = (s^ * x)(n). A sample whose square is not finite counts as 0, and the next update is refused. */
static void take_reference(anc_state *state, double x)
{
    double filtered;
    state->fault = ANC_ADAPTED;
    if (!isfinite(x * x)) {
        state->fault = ANC_BAD_INPUT;
        x = 0.0;
    }
    state->reference_start = push(state->reference, state->reference_start, ANC_REFERENCE_TAPS, x);
    filtered = dot(secondary_path, state->reference + state->reference_start, ANC_PATH_TAPS);
    if (!isfinite(filtered * filtered)) {
        state->fault = ANC_BAD_INPUT;
        filtered = 0.0;
    }
    state->filtered_start = push(state->filtered, state->filtered_start, ANC_TAPS, filtered);
}

/* Return d^(n) = e(n) + (s^ * y)(n). */
static double disturbance_estimate(const anc_state *state, double error)
{
    return error + dot(secondary_path, state->output + state->output_start, ANC_PATH_TAPS);
}

