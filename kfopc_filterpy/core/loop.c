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

static void play(anc_plant *p, const anc_signals *s, int64_t n)
{
    const int32_t taps = p->path_taps > p->feedback_taps ? p->path_taps : p->feedback_taps;
    const int32_t before = p->at;
    if (--p->at < 0) p->at = p->length - taps;
    for (int32_t sj = 0; sj < p->scenarios * p->loudspeakers; sj++) {
        real *row = p->output + times(sj, p->length);
        if (!before) memcpy(row + p->at + 1, row, sizeof(real) * (size_t)(taps - 1));
        row[p->at] = s->amplifier_output[sj * s->length + n];
    }
    for (int32_t scenario = 0; scenario < p->scenarios; scenario++)
        for (int32_t k = 0; k < p->microphones; k++) {
            const int32_t sk = scenario * p->microphones + k;
            const int64_t at = sk * s->length + n;
            real a = 0;
            for (int32_t j = 0; j < p->loudspeakers; j++)
                a += dot(p->path + times(sk * p->loudspeakers + j, p->path_taps), p->output + times(scenario * p->loudspeakers + j, p->length) + p->at, p->path_taps);
            s->anti_noise[at] = a;
            s->error[at] = p->error[sk] = s->disturbance[at] - a + (s->sensor_noise ? s->sensor_noise[at] : 0);
        }
}

/* Send the amplifiers' outputs through the paths: a = s * y_amp and e = d - a + sensor noise. */
void anc_play(anc_plant *p, const anc_signals *s, int64_t begin, int64_t end)
{
    for (int64_t n = begin; n < end; n++) play(p, s, n);
}

static void write_down(const anc_record *r, int64_t n)
{
    const int64_t row = r->every == 1 ? n : n / r->every;
    if (row * r->every != n) return;
    for (int64_t c = 0; c < r->count; c++) r->to[row * r->row + c * r->column] = r->from[c * r->step];
}

int64_t anc_run(const anc_controller *c, anc_plant *p, const anc_signals *s, const anc_record *records, int32_t n_records, int64_t begin, int64_t end, int32_t *status)
{
    const int32_t loudspeakers = p->scenarios * p->loudspeakers;
    int emitted = *status == ANC_DIVERGED;
    for (int64_t n = begin; n < end; n++, emitted = 0) {
        if (!emitted) {
            anc_hear(p, s, n);
            *status = ANC_REFUSED_REFERENCE;
            if (c->control_signal(c->self, p->reference, p->control)) return n;
        }
        *status = ANC_DIVERGED;
        for (int32_t sj = 0; sj < loudspeakers; sj++)
            if (!within(p->control[sj], p->limit[sj])) return n;
        for (int32_t sj = 0; sj < loudspeakers; sj++) {
            s->control_signal[sj * s->length + n] = p->control[sj];
            s->amplifier_output[sj * s->length + n] = anc_amplify(p->amplifiers + sj, p->control[sj]);
        }
        play(p, s, n);
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
        if (!adapt[n] && c->take_error && c->take_error(c->self, error)) return n;
        if (c->update(c->self, adapt[n] ? error : NULL)) return n;
    }
    *status = ANC_RUNNING;
    return end;
}
