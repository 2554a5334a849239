/* Return the running powers with one more sample, the constraint factor alpha(n) among them (eq. 10, 11 and 13). They
 * are plain means until the memory is full, and fade exponentially from then on. */
static anc_powers powers_with(const anc_state *state, double d)
{
    anc_powers next = state->powers;
#if MEANS
    const double equal_share = 1.0 / (double)(next.samples + 1);
    const double share = forgetting > equal_share ? forgetting : equal_share;
#endif
#if GAIN_ESTIMATED
    const double x = state->reference[state->reference_start];
    const double filtered = state->filtered[state->filtered_start];
#endif

#if POWER_ESTIMATED
    next.disturbance += share * (d * d - next.disturbance); /* eq. 10 */
#else
    (void)d; /* the disturbance power was given */
#endif
#if GAIN_ESTIMATED
    next.filtered += share * (filtered * filtered - next.filtered);
    next.reference += share * (x * x - next.reference);
    if (next.reference > silence)
        next.gain = next.filtered / next.reference; /* eq. 11; otherwise the reference is silent: the last gain */
#endif
#if MEANS
    if (next.samples < ANC_MEMORY)
        next.samples++;
#endif
    next.factor = 1.0;
    if (next.disturbance > silence && next.gain >= 0.0) { /* a negative gain is not known yet */
        const double factor = sqrt(rated_power * next.gain / next.disturbance); /* eq. 13 */
        if (factor < 1.0)
            next.factor = factor;
    }
    return next;
}

