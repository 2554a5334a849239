/* $description
 *
 * Exported by kfopc_filterpy, to continue from the state that the controller had then:
 *
 *     static anc_state state;
 *     anc_init(&state);
 *     for each sample:
 *         y = anc_control_signal(&state, x);    x(n) from the reference microphone, y(n) to the amplifier
 *         anc_update(&state, e);                e(n) = d(n) - (s * y)(n) from the error microphone
 *
 * Cost: $cost (additions, multiplications,
 * divisions and square roots). The constant that anc_init copies takes the same bytes in read-only memory.
 *
 * Bad input: a value is bad if it is NaN or Inf, or if its square overflows. A bad reference counts as 0, and anc_update
 * refuses that sample. It also refuses a bad error. A refused update changes nothing. If the weights have grown so much
 * that w'x overflows, the output is 0.
 *
 * Compile as C99 or later, without -ffast-math, which would remove the checks for NaN. There is no heap; of the library
 * only memcpy and functions of math.h are called.
 */
#ifndef ANC_H
#define ANC_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

$sizes
/* What anc_update returns. */
enum {
    ANC_ADAPTED = 0,
    ANC_BAD_INPUT = 1,   /* the error or this sample's reference is not finite, or a square overflows */
    ANC_NO_SOLUTION = 2, /* the innovation variance is not positive and finite, or the weights would overflow */
    ANC_DIVERGED = 3     /* the control signal overflows; the output is 0 */
};

$structs/* The state. All of it may be read; weights, gains and factors may also be set between two samples. */
typedef struct {
$fields} anc_state;

/* Set the state to that of the export. */
void anc_init(anc_state *state);

/* Return the control signal y(n) for the newest reference sample x(n), from the weights of the last sample. */
double anc_control_signal(anc_state *state, double reference);

/* Adapt to the error e(n) that this control signal left. Return ANC_ADAPTED, or why the update was refused. */
int anc_update(anc_state *state, double error);

#ifdef __cplusplus
}
#endif

#endif
