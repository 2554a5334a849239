/* The control loop: a reference, the controller, the amplifiers, the paths, the error, and the
 * controller again. */
#include "signals.h"

/* The delay line of what loudspeaker sj plays, newest sample first. */
static real *played(const anc_plant *p, int32_t sj)
{
    return p->output + times(sj, p->length) + p->at;
}

void anc_hear(anc_plant *p, const anc_signals *s, int64_t n)
{
    for (int32_t i = 0; i < p->references; i++) {
        real x = s->reference[i * s->length + n];
        /* the feedback of the loudspeakers, at least a sample late */
        for (int32_t j = 0; p->feedback_taps > 1 && j < p->loudspeakers; j++) {
            const real *path = p->feedback + times(i * p->loudspeakers + j, p->feedback_taps);
            x += dot(path + 1, played(p, j), p->feedback_taps - 1);
        }
        p->reference[i] = x;
    }
}

/* Make room for one more sample in every delay line. */
static void advance(anc_plant *p)
{
    const int32_t longest = p->path_taps > p->feedback_taps ? p->path_taps : p->feedback_taps;
    if (--p->at >= 0) return;
    p->at = p->length - longest;
    for (int32_t sj = 0; sj < p->scenarios * p->loudspeakers; sj++)
        copy(played(p, sj) + 1, p->output + times(sj, p->length), (size_t)(longest - 1));
}

/* One sample of `anc_play`. */
static void play(anc_plant *p, const anc_signals *s, int64_t n)
{
    const int32_t J = p->loudspeakers;
    advance(p);
    for (int32_t sj = 0; sj < p->scenarios * J; sj++)
        *played(p, sj) = s->amplifier_output[sj * s->length + n];
    for (int32_t sk = 0; sk < p->scenarios * p->microphones; sk++) {
        const int64_t at = sk * s->length + n;
        const real *output = played(p, sk / p->microphones * J);
        real a = 0; /* a = s * y_amp */
        for (int32_t j = 0; j < J; j++)
            a += dot(p->path + times(sk * J + j, p->path_taps), output + times(j, p->length),
                     p->path_taps);
        const real noise = s->sensor_noise ? s->sensor_noise[at] : 0;
        s->anti_noise[at] = a;
        p->error[sk] = s->disturbance[at] - a + noise; /* e = d - a + noise */
        s->error[at] = p->error[sk];
    }
}

void anc_play(anc_plant *p, const anc_signals *s, int64_t begin, int64_t end)
{
    for (int64_t n = begin; n < end; n++) play(p, s, n);
}

static void write_down(const anc_record *r, int64_t n)
{
    const int64_t row = r->every == 1 ? n : n / r->every;
    if (row * r->every != n) return;
    for (int64_t c = 0; c < r->count; c++)
        r->to[row * r->row + c * r->column] = r->from[c * r->step];
}

/* Return whether all control signals are within their limits. */
static int converges(const anc_plant *p)
{
    for (int32_t sj = 0; sj < p->scenarios * p->loudspeakers; sj++)
        if (!within(p->control[sj], p->limit[sj])) return 0;
    return 1;
}

static void amplify(const anc_plant *p, const anc_signals *s, int64_t n)
{
    for (int32_t sj = 0; sj < p->scenarios * p->loudspeakers; sj++) {
        const int64_t at = sj * s->length + n;
        s->control_signal[at] = p->control[sj];
        s->amplifier_output[at] = anc_amplify(p->amplifiers + sj, p->control[sj]);
    }
}

int64_t anc_run(const anc_controller *c, anc_plant *p, const anc_signals *s,
                const anc_record *records, int32_t n_records, int64_t begin, int64_t end,
                int32_t *status)
{
    int given = *status == ANC_DIVERGED; /* the control signals of sample `begin` */
    for (int64_t n = begin; n < end; n++) {
        if (!given) {
            anc_hear(p, s, n);
            *status = ANC_REFUSED_REFERENCE;
            if (c->control_signal(c->self, p->reference, p->control)) return n;
        }
        given = 0;
        *status = ANC_DIVERGED;
        if (!converges(p)) return n;
        amplify(p, s, n);
        play(p, s, n);
        *status = ANC_REFUSED_ERROR;
        if (c->update(c->self, p->error)) return n;
        for (int32_t r = 0; r < n_records; r++) write_down(records + r, n);
    }
    *status = ANC_RUNNING;
    return end;
}

int64_t anc_process(const anc_controller *c, int32_t references, int32_t loudspeakers,
                    int32_t microphones, const anc_real *x, const anc_real *e, anc_real *y,
                    const uint8_t *adapt, int64_t length, int64_t begin, int64_t end,
                    anc_real *scratch, int32_t *status)
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
