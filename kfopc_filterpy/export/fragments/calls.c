void anc_init(anc_state *state)
{
    memcpy(state, &initial, sizeof *state);
}

double anc_control_signal(anc_state *state, double reference)
{
    double y;
    take_reference(state, reference);
    y = dot(state->weights, state->reference + state->reference_start, ANC_TAPS);
    if (!isfinite(y)) {
        state->fault = ANC_DIVERGED;
        y = 0.0;
    }
#if LIMITER
    y = limit(&state->limiter, y);
#endif
    state->output_start = push(state->output, state->output_start, ANC_PATH_TAPS, y);
    return y;
}

int anc_update(anc_state *state, double error)
{
    if (state->fault != ANC_ADAPTED)
        return state->fault;
    if (!isfinite(error * error))
        return ANC_BAD_INPUT;
    return adapt(state, error);
}
