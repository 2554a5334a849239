/* Runs an exported controller on a stream of binary float64.
 *
 * Input: x(n) and e(n) of each sample, of all channels. Output: the size of the state, what two self-tests returned, before
 * and after the samples, then y(n) and what the update returned for each sample. Half way, a copy of the state goes on in its
 * place. With FIRST=1, the controller was exported between the two calls of a sample, and that of sample 0 is the second.
 * PATH is the true secondary path of one channel: the errors are then what it leaves of the disturbances that are read.
 */
#include "anc.h"

#include <stdio.h>
#include <string.h>

enum { K = ANC_MICROPHONES, J = ANC_LOUDSPEAKERS, I = ANC_REFERENCES, SWITCHED = 2500 };

static anc_state states[2];

static const double path[] = {PATH};
static double played[sizeof path / sizeof *path];

static double arriving(double y)
{
    double sum = 0;
    for (size_t k = sizeof path / sizeof *path - 1; k > 0; k--) sum += path[k] * (played[k] = played[k - 1]);
    return sum + path[0] * (played[0] = y);
}

static void put(double value) { fwrite(&value, sizeof value, 1, stdout); }

int main(void)
{
    anc_state *state = states;
    double in[I + K];
    put((double)sizeof *state);
    put(anc_self_test(state));
    put(anc_self_test(state)); /* the state is that of the export again */
    for (long n = 0; fread(in, sizeof in, 1, stdin) == 1; n++) {
        NUMBER x[I], e[K], y[J] = {0};
        for (int i = 0; i < I; i++) x[i] = (NUMBER)in[i];
        if (n == SWITCHED) {
            states[1] = states[0];
            memset(states, 0xff, sizeof *states);
            state = states + 1;
        }
#ifdef ARRAYS
        if (n >= FIRST) anc_control_signal(state, x, y);
#else
        if (n >= FIRST) y[0] = anc_control_signal(state, x[0]);
#endif
        in[I] -= arriving((double)y[0]);
        for (int k = 0; k < K; k++) e[k] = (NUMBER)in[I + k];
#ifdef ARRAYS
        const int answer = anc_update(state, e);
#else
        const int answer = anc_update(state, e[0]);
#endif
        for (int j = 0; j < J; j++) put((double)y[j]);
        put(answer);
    }
    return 0;
}
