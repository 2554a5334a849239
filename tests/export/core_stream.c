/* Runs an exported controller of the core on a stream of binary float64.
 *
 * Input: x(n) and e(n) of each sample, of all channels. Output: the size of the state, what two self-tests returned, before
 * and after the samples, then y(n) and what the update returned for each sample. From half a second on, a copy of the state
 * goes on in its place.
 */
#include "anc.h"

#include <stdio.h>
#include <string.h>

enum { K = ANC_MICROPHONES, J = ANC_LOUDSPEAKERS, I = ANC_REFERENCES, SWITCHED = 8000 };

static anc_state states[2];

static void put(double value) { fwrite(&value, sizeof value, 1, stdout); }

int main(void)
{
    anc_state *state = states;
    double in[I + K];
    put((double)sizeof *state);
    put(anc_self_test(state));
    put(anc_self_test(state)); /* the state is that of the export again */
    for (long n = 0; fread(in, sizeof in, 1, stdin) == 1; n++) {
        real x[I], e[K], y[J];
        for (int i = 0; i < I; i++) x[i] = (real)in[i];
        for (int k = 0; k < K; k++) e[k] = (real)in[I + k];
        if (n == SWITCHED) {
            states[1] = states[0];
            memset(states, 0xff, sizeof *states);
            state = states + 1;
        }
#ifdef ARRAYS
        anc_control_signal(state, x, y);
        const int answer = anc_update(state, e);
#else
        y[0] = anc_control_signal(state, x[0]);
        const int answer = anc_update(state, e[0]);
#endif
        for (int j = 0; j < J; j++) put((double)y[j]);
        put(answer);
    }
    return 0;
}
