/* $description
 *
 * Exported by kfopc_filterpy, to continue from the state that the controller had then:
 *
 *     static ${name}_state state;
 *     ${name}_init(&state);
 *     for each sample:
 *         $statement    ${x_from}y(n) to the amplifier$s
 *         ${name}_update(&state, e);    e(n) = d(n) - (s * y)(n) from the error microphone$s
 *
 * The state has $n_bytes bytes if a pointer has 8. No heap is used, and there is no state
 * elsewhere.
 *
 * Compile with these flags:
 *     $flags
 * Then the result has the bits of kfopc_filterpy's core in $real, on every machine.
 * -ffp-contract=off decides the bits, -fno-strict-aliasing is needed, the others are for speed.
 * -ffast-math is refused. Of the C library it uses memcpy, memmove, memset, strcmp and math.h.
 *
 * Bad input: a reference or an error that is NaN, infinite or too loud to be squared and filtered
 * without overflow. A bad reference counts as 0, and ${name}_update refuses that sample. It also
 * refuses a disturbance estimate e + s^ * y that is too loud, a step of the weights that is too
 * large, and a covariance so large that the next one could overflow (${NAME}_NO_SOLUTION). A
 * refused update changes no weight. An output is never NaN or infinite: if the weights have grown
 * that much, it is 0.
 *
 * A state that was never initialised, zeroed or not, or that is of another export, is initialised
 * by its first call. One that is NULL, or not aligned as its type must be, is left alone: the
 * output is 0, and ${name}_update returns ${NAME}_NO_STATE. C++ can include this header; the source
 * file is C.
 */
#ifndef ${NAME}_EXPORTED_H
#define ${NAME}_EXPORTED_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ${NAME}_MICROPHONES $K
#define ${NAME}_LOUDSPEAKERS $J
#define ${NAME}_REFERENCES $I
#define ${NAME}_TAPS $L /* of a control filter */

/* What ${name}_update returns. */
$answers
/* All that changes. A copy of it is a copy of the controller. */
typedef struct {
    $real block[$n_reals];
    void *view[$n_places];  /* where the fields stand in `block` */
    const void *opened; /* the state that they were found for */
    int32_t fault;      /* of this sample's reference */
    uint32_t mark;      /* tells that the state is one of this export */
} ${name}_state;

/* Set the state to that of the export. */
void ${name}_init(${name}_state *state);

/* $returns the control signal y(n)$for_x, from the weights of the last sample. */
$declared_control;

/* Adapt to the error e(n) that this control signal left. Return ${NAME}_ADAPTED, or why the update
 * was refused. */
$declared_update;

/* Run known samples from the state of the export, and compare with what Python computed for them,
 * bit for bit. Return 0 if they agree. Afterwards the state is that of the export, as after
 * ${name}_init. */
int ${name}_self_test(${name}_state *state);

#ifdef __cplusplus
}
#endif

#endif
