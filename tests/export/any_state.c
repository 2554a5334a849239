/* States of zeros, of rubbish and of another export begin like one that was initialised; no state
 * is silence.
 *
 * It ends with 0 if that is so. With ARRAYS, samples are arrays.
 */
#include "anc.h"
#include "other.h"

#include <string.h>

static anc_state states[4];
static union {
    anc_state state;
    char bytes[sizeof(anc_state) + 1];
} room;
static double out[4][ANC_LOUDSPEAKERS];

static int run(anc_state *s, double *y) /* what the last update returns */
{
    int answer = 0;
    for (int n = 0; n < 50; n++) {
        double x[ANC_REFERENCES], e[ANC_MICROPHONES];
        for (int i = 0; i < ANC_REFERENCES; i++) x[i] = (n * 7 + i) % 5 - 2;
        for (int k = 0; k < ANC_MICROPHONES; k++)
            e[k] = ((n * 3 + k) % 7 - 3) / 100.0; /* loud ones silence KF-PB */
#ifdef ARRAYS
        anc_control_signal(s, x, y);
        answer = anc_update(s, e);
#else
        y[0] = anc_control_signal(s, x[0]);
        answer = anc_update(s, e[0]);
#endif
    }
    return answer;
}

int main(void)
{
    int failed = 0;
    anc_init(&states[0]);
    memset(&states[2], 0xa5, sizeof *states);
    other_init((other_state *)&states[3]); /* a smaller state */
    for (int i = 0; i < 4; i++) {
        failed |= run(&states[i], out[i]) != ANC_ADAPTED;
        failed |= memcmp(out[i], out[0], sizeof *out) || out[i][0] == 0;
    }
    for (int i = 0; i < 2; i++) {
        anc_state *nowhere = i ? (anc_state *)(void *)(room.bytes + 1) : NULL;
        anc_init(nowhere);
        failed |= !anc_self_test(nowhere) || run(nowhere, out[1]) != ANC_NO_STATE || out[1][0] != 0;
    }
    return failed;
}
