/* Runs an exported controller on a stream of binary float64.
 *
 * Input: the number of taps of the true secondary path, the taps, then x(n) and d(n) of each sample. The error is
 * e(n) = d(n) - (s * y)(n); without taps it is d(n). Output: the size of the state, then y(n) and what the update returned
 * for each sample, and at the end the weights.
 */
#include "anc.h"

#include <stdio.h>

#define LONGEST 4096

static anc_state state;

static int get(double *value)
{
    return fread(value, sizeof *value, 1, stdin) == 1;
}

static void put(double value)
{
    fwrite(&value, sizeof value, 1, stdout);
}

int main(void)
{
    static double path[LONGEST], played[LONGEST];
    double size, x, d;
    int taps;
    if (!get(&size) || !(size >= 0.0 && size <= LONGEST))
        return 1;
    taps = (int)size;
    for (int k = 0; k < taps; k++)
        if (!get(&path[k]))
            return 1;
    anc_init(&state);
    put((double)sizeof state);
    while (get(&x) && get(&d)) {
        const double y = (double)anc_control_signal(&state, (real)x);
        for (int k = taps - 1; k > 0; k--)
            played[k] = played[k - 1];
        played[0] = y;
        for (int k = 0; k < taps; k++)
            d -= path[k] * played[k];
        put(y);
        put((double)anc_update(&state, (real)d));
    }
    for (int k = 0; k < ANC_TAPS; k++)
        put((double)state.weights[k]);
    return 0;
}
