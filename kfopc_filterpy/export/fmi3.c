/* The controller of $source as a unit of FMI 3.0 for co-simulation.
 *
 * A step is a sample: the error e is what the last control signal left, then the reference x gives
 * the next one. So the outputs do not depend on the inputs of the same moment. */
#include "$header"

#include "fmi3Functions.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef __GNUC__ /* the standard says which parameters a function has */
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

enum { I = ${NAME}_REFERENCES, K = ${NAME}_MICROPHONES, J = ${NAME}_LOUDSPEAKERS };
/* Value references: the time, then x, e and y of all channels, and after them what the update
 * returned. */
enum { TIME, X, E = X + I, Y = E + K, ANSWER = Y + J };
static const double PERIOD = $period;

typedef struct {
    ${name}_state controller;
    $real value[ANSWER]; /* by value reference */
    fmi3Int32 answer;
    int begun; /* there was a control signal that an error can tell of */
} model;

typedef struct {
    model now;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} unit;

static fmi3Status refused(const unit *one, const char *why)
{
    if (one && one->log) one->log(one->environment, fmi3Error, "logStatusError", why);
    return fmi3Error;
}

static void begin(model *now)
{
    memset(now, 0, sizeof *now);
    ${name}_init(&now->controller);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
    const fmi3ValueReference intermediate[], size_t n_intermediate,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update)
{
    unit *one = token && !strcmp(token, "$token") ? malloc(sizeof *one) : NULL;
    if (!one) {
        const char *why = "the token is that of another unit, or no memory is left";
        if (log) log(environment, fmi3Error, "logStatusError", why);
        return NULL;
    }
    one->environment = environment;
    one->log = log;
    begin(&one->now);
    return one;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3Reset(fmi3Instance instance)
{
    begin(&((unit *)instance)->now);
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_end, fmi3Float64 end)
{
    ((unit *)instance)->now.value[TIME] = ($real)start;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) { return fmi3OK; }
fmi3Status fmi3EnterStepMode(fmi3Instance instance) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance instance) { return fmi3OK; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n,
                               const fmi3String categories[])
{
    /* errors are always logged */
    return fmi3OK;
}

fmi3Status fmi3Get$number(fmi3Instance instance, const fmi3ValueReference at[], size_t n,
                          fmi3$number values[], size_t n_values)
{
    unit *one = instance;
    if (n != n_values) return refused(one, "a variable has one value");
    for (size_t i = 0; i < n; i++) {
        if (at[i] >= ANSWER) return refused(one, "there is no such $number");
        values[i] = one->now.value[at[i]];
    }
    return fmi3OK;
}

fmi3Status fmi3GetInt32(fmi3Instance instance, const fmi3ValueReference at[], size_t n,
                        fmi3Int32 values[], size_t n_values)
{
    unit *one = instance;
    for (size_t i = 0; i < n; i++) {
        if (at[i] != ANSWER || n != n_values) return refused(one, "there is no such Int32");
        values[i] = one->now.answer;
    }
    return fmi3OK;
}

fmi3Status fmi3Set$number(fmi3Instance instance, const fmi3ValueReference at[], size_t n,
                          const fmi3$number values[], size_t n_values)
{
    unit *one = instance;
    if (n != n_values) return refused(one, "a variable has one value");
    for (size_t i = 0; i < n; i++) {
        if (at[i] < X || at[i] >= Y) return refused(one, "only references and errors can be set");
        one->now.value[at[i]] = values[i];
    }
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 step,
                      fmi3Boolean no_set_before, fmi3Boolean *events, fmi3Boolean *terminate,
                      fmi3Boolean *early, fmi3Float64 *last)
{
    unit *one = instance;
    model *now = &one->now;
    $real *x = now->value + X, *e = now->value + E, *y = now->value + Y;
    *events = *terminate = *early = fmi3False;
    *last = time;
    if (!(fabs(step - PERIOD) <= 1e-6 * PERIOD))
        return refused(one, "a step must be a sample, $period s");
    if (now->begun) now->answer = $update;
    now->begun = 1;
    $control
    *last = time + step;
    now->value[TIME] = ($real)*last;
    return fmi3OK;
}

/* The state of a unit: a model in memory of its own. */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    if (!*state) *state = malloc(sizeof(model));
    if (!*state) return refused(instance, "no memory is left");
    memcpy(*state, &((unit *)instance)->now, sizeof(model));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state)
{
    model *now = &((unit *)instance)->now;
    memcpy(now, state, sizeof *now);
    now->controller.opened = NULL; /* its addresses are those of another place, or process */
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
    *size = sizeof(model);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[],
                                 size_t size)
{
    if (size != sizeof(model)) return refused(instance, "a serialized state has another size");
    memcpy(bytes, state, size);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    if (size != sizeof(model)) return refused(instance, "a serialized state has another size");
    if (!*state) *state = malloc(size);
    if (!*state) return refused(instance, "no memory is left");
    memcpy(*state, bytes, size);
    return fmi3OK;
}

/* What the standard names beyond that, and a unit must define too. */
