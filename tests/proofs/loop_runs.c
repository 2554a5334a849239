/* The loop and the processing of blocks, for ever: any signals, and a controller that may answer
 * anything. */
#include "signals.h"
#include "any.h"

enum { S = 2, K = 2, J = 2, I = 2, M = 3, F = 2, ROOM = 5, N = 4 };

static int control_signal(void *self, const anc_real *reference, anc_real *control)
{
    for (int sj = 0; sj < *(int *)self; sj++) control[sj] = reference[sj % I] + any();
    return Frama_C_interval(0, 5);
}

static int take(void *self, const anc_real *error)
{
    anc_real sum = 0;
    for (int sk = 0; error && sk < *(int *)self; sk++) sum += error[sk];
    return sum > 1 ? Frama_C_interval(0, 5) : 0;
}

static anc_real path[S * K * J * M], feedback[I * J * F], output[S * J * ROOM], x[I], y[S * J],
    e[S * K], limit[S * J];
static anc_real heard[I * N], noise[S * K * N], sensor[S * K * N], controls[S * J * N],
    amplified[S * J * N];
static anc_real anti_noise[S * K * N], written[N * S * K], scratch[I + J + K];

static void any_numbers(anc_real *to, int n)
{
    for (int i = 0; i < n; i++) to[i] = any();
}

int main(void)
{
    static const anc_amplifier amplifiers[S * J] = {
        {ANC_HARD_CLIP, 1, 1}, {ANC_SOFT_SATURATION, 1, 2}, {ANC_LINEAR, 1, 1}};
    static int all = S * J, one = J;
    const anc_controller loop = {&all, control_signal, take, take},
                         blocks = {&one, control_signal, take,
                                   Frama_C_interval(0, 1) ? take : NULL};
    anc_plant plant = {S,    K,        J,          I,      M, F, 0, ROOM,
                       path, feedback, amplifiers, output, x, y, e, limit};
    const anc_signals signals = {
        N,      heard,    noise,     Frama_C_interval(0, 1) ? sensor : NULL,
        sensor, controls, amplified, anti_noise};
    const anc_record records[] = {{e, 1, S * K, Frama_C_interval(1, 2), S * K, 1, written}};
    for (;;) {
        const uint8_t adapt[N] = {Frama_C_interval(0, 1), 1, 0, 1};
        int32_t status = Frama_C_interval(0, 3);
        any_numbers(path, S * K * J * M);
        any_numbers(feedback, I * J * F);
        any_numbers(limit, S * J);
        any_numbers(heard, I * N);
        any_numbers(noise, S * K * N);
        any_numbers(sensor, S * K * N);
        anc_run(&loop, &plant, &signals, records, 1, Frama_C_interval(0, N), N, &status);
        anc_process(&blocks, I, J, K, heard, noise, controls, adapt, N, Frama_C_interval(0, N), N,
                    scratch, &status);
    }
}
