/* The output limiter: the energy of the last ANC_WINDOW outputs never exceeds the rating. Energies are in units of the
 * energy that a window may have. At position i of a lap of ANC_WINDOW samples, laps_out[k] is minus this lap's output
 * energy up to k for k < i and the last lap's from k on for k > i, so the energy of any recent span is one sum. laps_in
 * holds the same of the input. */

static double smaller(double a, double b) { return a < b ? a : b; }
static double larger(double a, double b) { return a > b ? a : b; }

/* Return the largest constant gain that keeps to the rating over every horizon, for the worst input expected. */
static double sustainable_gain(anc_limiter *limiter)
{
    const int32_t i = limiter->position;
    const double known = (1.0 + limiter_reserve) * limiter->known;
    const int louder = limiter->arrived + limiter->laps_in[i + 1] > known;
    double room = 1.0;
    for (int32_t k = 0; k < ANC_HORIZONS; k++) {
        const int32_t h = limiter_horizons[k];
        const int32_t before = i >= h ? i - h : i - h + ANC_WINDOW + 1;
        const int32_t kept = i + h <= ANC_WINDOW ? i + h : i + h - ANC_WINDOW - 1;
        double coming, left;
        limiter->held[k] = larger(limiter->held[k] * limiter_fade, limiter->arrived + limiter->laps_in[before]);
        limiter->held[k] = larger(limiter->held[k], limiter_floor);
        coming = smaller(limiter->held[k], (double)h * limiter->loud);
        if (!louder)
            coming = smaller(coming, known - (limiter->arrived + limiter->laps_in[kept]));
        left = smaller(1.0 - (limiter->spent + limiter->laps_out[kept]), limiter_room[k]);
        room = smaller(room, left / larger(coming, limiter_floor));
    }
    return sqrt(larger(room, 0.0));
}

/* Start a new lap. The energies are summed from scratch, without differences: the guarantee depends on it. */
static void start_lap(anc_limiter *limiter)
{
    double rest = 0.0;
    for (int32_t k = ANC_WINDOW - 1; k > 0; k--) {
        rest += limiter->squares[k];
        limiter->laps_out[k] = rest;
        limiter->laps_in[k] = limiter->arrived + limiter->laps_in[k - 1];
    }
    limiter->position = 0;
    limiter->spent = 0.0;
    limiter->arrived = 0.0;
    limiter->known = limiter->held[ANC_HORIZONS - 1];
}

/* Return the output for the next input u, which must be finite. */
static double limit(anc_limiter *limiter, double u)
{
    const int32_t i = limiter->position;
    const double planned = smaller(fabs(u), limiter_planned) * limiter_scale;
    const double energy = planned * planned;
    double aim, wanted, y, square, left;

    limiter->arrived += energy;
    limiter->laps_in[i] = -limiter->arrived;
    limiter->average = larger(limiter->average + limiter_attack * (energy - limiter->average), limiter_floor);
    limiter->loud = larger(limiter->loud * limiter_calm, limiter->average);
    aim = sustainable_gain(limiter);
    limiter->gain = smaller(aim, limiter->gain + limiter_release * larger(limiter_overshoot * aim - limiter->gain, 0.0));

    wanted = limiter->gain * u;
    y = smaller(larger(wanted, -limiter_limit), limiter_limit);
    square = (y * limiter_scale) * (y * limiter_scale);
    left = limiter_budget - (limiter->spent + limiter->laps_out[i + 1]);
    if (square > left) { /* the guarantee; the gain above makes this rare */
        y = copysign(limiter_peak * sqrt(larger(left, 0.0)), u);
        square = (y * limiter_scale) * (y * limiter_scale);
    }
    if (y != wanted && limiter->clipped < INT32_MAX)
        limiter->clipped++;
    limiter->spent += square;
    limiter->laps_out[i] = -limiter->spent;
    limiter->squares[i] = square;
    limiter->position = i + 1;
    if (i + 1 == ANC_WINDOW)
        start_lap(limiter);
    return y;
}

