/* Runs $source: the self-test, then some samples of noise. Put your converters where the comments
 * say so. */
#include "$header"

#include <stdio.h>

enum { SAMPLES = 100 };

static ${name}_state state;

int main(void)
{
    unsigned long noise = 1;
    int refused = 0;
    $real x[$room], e[${NAME}_MICROPHONES], y[${NAME}_LOUDSPEAKERS], loudest = 0;
    if (${name}_self_test(&state)) {
        puts("the self-test failed: this compiler, or one of its flags, changes the arithmetic");
        return 1;
    }
    ${name}_init(&state);
    for (int n = 0; n < SAMPLES; n++) {
        for (int i = 0; i < $room; i++) { /* x(n), from the reference microphones */
            noise = (1103515245UL * noise + 12345UL) & 0x7fffffffUL;
            x[i] = ($real)((long)(noise >> 16) - 16384) / 16384;
        }
        $control
        for (int j = 0; j < ${NAME}_LOUDSPEAKERS; j++) /* y(n), to the amplifiers */
            if (y[j] > loudest) loudest = y[j];
        for (int k = 0; k < ${NAME}_MICROPHONES; k++) /* e(n), from the error microphones */
            e[k] = x[0] / 4;
        if ($update != ${NAME}_ADAPTED) refused++;
    }
    printf("%d samples, largest y %g, %d updates refused\n", SAMPLES, (double)loudest, refused);
    return 0;
}
