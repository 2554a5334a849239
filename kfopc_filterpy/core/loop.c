/* The control loop: a reference, the controller, the amplifiers, the paths, the error, and the controller again. */
#include "signals.h"
#include <string.h>

/* Set the reference: the noise, plus the feedback of the loudspeakers, at least a sample late. */
void anc_hear(anc_plant *p, const anc_signals *s, int64_t n)
{
    for (int32_t i = 0; i < p->references; i++) {
        p->reference[i] = s->reference[i * s->length + n];
        for (int32_t j = 0; p->feedback_taps > 1 && j < p->loudspeakers; j++)
            p->reference[i] += dot(p->feedback + times(i * p->loudspeakers + j, p->feedback_taps) + 1, p->output + times(j, p->length) + p->at, p->feedback_taps - 1);
    }
}

/* Send the amplifiers' outputs through the paths: a = s * y_amp and e = d - a + sensor noise. */
void anc_play(anc_plant *p, const real *amplified, const anc_signals *s, int64_t n)
{
    const int32_t taps = p->path_taps > p->feedback_taps ? p->path_taps : p->feedback_taps;
    const int32_t before = p->at;
    if (--p->at < 0) p->at = p->length - taps;
    for (int32_t j = 0; j < p->loudspeakers; j++) {
        real *row = p->output + times(j, p->length);
        if (!before) memcpy(row + p->at + 1, row, sizeof(real) * (size_t)(taps - 1));
        row[p->at] = s->amplifier_output[j * s->length + n] = amplified[j];
    }
    for (int32_t k = 0; k < p->microphones; k++) {
        real a = 0;
        for (int32_t j = 0; j < p->loudspeakers; j++) a += dot(p->path + times(k * p->loudspeakers + j, p->path_taps), p->output + times(j, p->length) + p->at, p->path_taps);
        s->anti_noise[k * s->length + n] = a;
        p->error[k] = s->disturbance[k * s->length + n] - a + (s->sensor_noise ? s->sensor_noise[k * s->length + n] : 0);
        s->error[k * s->length + n] = p->error[k];
    }
}

static void write_down(const anc_record *r, int64_t n)
{
    if (n % r->every) return;
    for (int64_t c = 0; c < r->count; c++) r->to[n / r->every * r->row + c * r->column] = r->from[c * r->step];
}

int64_t anc_run(const anc_controller *c, anc_plant *p, const anc_signals *s, const anc_record *records, int32_t n_records, int64_t begin, int64_t end, int32_t *status)
{
    for (int64_t n = begin; n < end; n++) {
        anc_hear(p, s, n);
        *status = ANC_REFUSED_REFERENCE;
        if (c->control_signal(c->self, p->reference, p->control)) return n;
        *status = ANC_DIVERGED;
        for (int32_t j = 0; j < p->loudspeakers; j++)
            if (!within(p->control[j], p->limit[j])) return n;
        for (int32_t j = 0; j < p->loudspeakers; j++) {
            s->control_signal[j * s->length + n] = p->control[j];
            p->control[j] = anc_amplify(p->amplifiers + j, p->control[j]);
        }
        anc_play(p, p->control, s, n);
        *status = ANC_REFUSED_ERROR;
        if (c->update(c->self, p->error)) return n;
        for (int32_t r = 0; r < n_records; r++) write_down(records + r, n);
    }
    *status = ANC_RUNNING;
    return end;
}

int64_t anc_process(const anc_controller *c, int32_t references, int32_t loudspeakers, int32_t microphones, const real *x, const real *e, real *y, const uint8_t *adapt, int64_t length, int64_t begin, int64_t end, real *scratch, int32_t *status)
{
    real *reference = scratch, *control = reference + references, *error = control + loudspeakers;
    for (int64_t n = begin; n < end; n++) {
        for (int32_t i = 0; i < references; i++) reference[i] = x[i * length + n];
        for (int32_t k = 0; k < microphones; k++) error[k] = e[k * length + n];
        *status = ANC_REFUSED_REFERENCE;
        if (c->control_signal(c->self, reference, control)) return n;
        *status = ANC_REFUSED_ERROR;
        for (int32_t j = 0; j < loudspeakers; j++) y[j * length + n] = control[j];
        if (c->update(c->self, adapt[n] ? error : NULL)) return n;
    }
    *status = ANC_RUNNING;
    return end;
}
