/* FMI 3.0 over an instance of a model. */
#include "model.h"
#include "fmi3Functions.h"

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Host;

static void to_host(Instance *m, int warning, const char *message)
{
    const Host *host = m->host;
    if (host->log == NULL) return;
    host->log(host->environment, warning ? fmi3Warning : fmi3Error, warning ? "logStatusWarning" : "logStatusError", message);
}

#define STATUS(refused) ((refused) ? fmi3Error : fmi3OK)
#define TRIED(refused) ((refused) == UNDEFINED ? fmi3Discard : STATUS(refused)) /* a solver may try another step */
#define KNOWN(instance) \
    Instance *m = instance; \
    if (m == NULL) return fmi3Error

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean on, size_t count, const fmi3String categories[])
{
    KNOWN(i);
    (void)m, (void)on, (void)count, (void)categories; /* errors and warnings are always said, nothing else ever is */
    return fmi3OK;
}

static fmi3Instance instantiated(int exchange, fmi3String token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    Host *host = calloc(1, sizeof *host);
    if (host == NULL) return NULL;
    host->environment = environment;
    host->log = log;
    Instance *m = created(exchange, host, to_host);
    int refused = m == NULL;
    if (m != NULL && (token == NULL || strcmp(token, MODEL_GUID) != 0))
        refused = refuse(m, "the instantiation token is %s; this library is of %s", token ? token : "missing", MODEL_GUID);
    if (m != NULL && exchange && !EXCHANGE) refused = refuse(m, "this FMU is for co-simulation only");
    if (!refused) return m;
    if (m != NULL) dispose(m);
    free(host);
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name, (void)resources, (void)visible, (void)logging;
    return instantiated(1, token, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[],
                                         size_t count, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback between)
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)count, (void)between;
    return instantiated(0, token, environment, log);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock, (void)lock, (void)unlock;
    if (log != NULL) log(environment, fmi3Error, "logStatusError", "this FMU has no scheduled execution");
    return NULL;
}

void fmi3FreeInstance(fmi3Instance i)
{
    Instance *m = i;
    if (m == NULL) return;
    free(m->host);
    dispose(m);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop)
{
    KNOWN(i);
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return STATUS(start_at(m, start) || enter_initialization(m));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance i)
{
    KNOWN(i);
    return STATUS(exit_initialization(m));
}

fmi3Status fmi3Terminate(fmi3Instance i)
{
    KNOWN(i);
    if (in_phase(m, IN(STEP) | IN(EVENT) | IN(CONTINUOUS), "it is terminated")) return fmi3Error;
    m->phase = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance i)
{
    KNOWN(i);
    reset(m);
    return fmi3OK;
}

/* -- values ----------------------------------------------------------------------------------------------------------- */

static int scalars(Instance *m, size_t count, size_t values)
{
    return count != values && refuse(m, "there are %zu variables and %zu values; all of them are scalars", count, values);
}

fmi3Status fmi3GetFloat64(fmi3Instance i, const fmi3ValueReference vr[], size_t count, fmi3Float64 value[], size_t values)
{
    KNOWN(i);
    if (scalars(m, count, values) || readable(m)) return fmi3Error;
    for (size_t k = 0; k < count; k++) {
        if (vr[k] < VARIABLES && variables[vr[k]].kind == REAL) value[k] = m->values[vr[k]];
        else if (get_local(m, vr[k], &value[k])) return fmi3Error;
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance i, const fmi3ValueReference vr[], size_t count, const fmi3Float64 value[], size_t values)
{
    KNOWN(i);
    if (scalars(m, count, values)) return fmi3Error;
    for (size_t k = 0; k < count; k++)
        if (set_number(m, vr[k], REAL, value[k])) return fmi3Error;
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance i, const fmi3ValueReference vr[], size_t count, fmi3Boolean value[], size_t values)
{
    KNOWN(i);
    if (scalars(m, count, values)) return fmi3Error;
    for (size_t k = 0; k < count; k++) {
        if (is_kind(m, vr[k], BOOLEAN)) return fmi3Error;
        value[k] = m->values[vr[k]] != 0.0;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance i, const fmi3ValueReference vr[], size_t count, const fmi3Boolean value[], size_t values)
{
    KNOWN(i);
    if (scalars(m, count, values)) return fmi3Error;
    for (size_t k = 0; k < count; k++)
        if (set_number(m, vr[k], BOOLEAN, value[k] ? 1.0 : 0.0)) return fmi3Error;
    return fmi3OK;
}

fmi3Status fmi3GetString(fmi3Instance i, const fmi3ValueReference vr[], size_t count, fmi3String value[], size_t values)
{
    KNOWN(i);
    if (scalars(m, count, values)) return fmi3Error;
    for (size_t k = 0; k < count; k++) {
        if (is_kind(m, vr[k], STRING)) return fmi3Error;
        value[k] = m->text[(size_t)variables[vr[k]].start];
    }
    return fmi3OK;
}

fmi3Status fmi3SetString(fmi3Instance i, const fmi3ValueReference vr[], size_t count, const fmi3String value[], size_t values)
{
    KNOWN(i);
    if (scalars(m, count, values)) return fmi3Error;
    for (size_t k = 0; k < count; k++)
        if (set_text(m, vr[k], value[k])) return fmi3Error;
    return fmi3OK;
}

/* Types of which no variable is. */
#define NO_VARIABLES(type) \
    fmi3Status fmi3Get##type(fmi3Instance i, const fmi3ValueReference vr[], size_t count, fmi3##type value[], size_t values) \
    { \
        KNOWN(i); \
        (void)vr, (void)value, (void)values; \
        return STATUS(count > 0 && refuse(m, "there is no " #type)); \
    } \
    fmi3Status fmi3Set##type(fmi3Instance i, const fmi3ValueReference vr[], size_t count, const fmi3##type value[], size_t values) \
    { \
        KNOWN(i); \
        (void)vr, (void)value, (void)values; \
        return STATUS(count > 0 && refuse(m, "there is no " #type)); \
    }

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)

/* Functions of which no variable of ours knows anything. */
#define REFUSED(name, parameters, unused, what) \
    fmi3Status name parameters \
    { \
        KNOWN(i); \
        unused; \
        return STATUS(refuse(m, "this FMU has no " what)); \
    }
#define VRS const fmi3ValueReference vr[], size_t count

REFUSED(fmi3GetBinary, (fmi3Instance i, VRS, size_t sizes[], fmi3Binary value[], size_t values),
        ((void)vr, (void)count, (void)sizes, (void)value, (void)values), "Binary")
REFUSED(fmi3SetBinary, (fmi3Instance i, VRS, const size_t sizes[], const fmi3Binary value[], size_t values),
        ((void)vr, (void)count, (void)sizes, (void)value, (void)values), "Binary")
REFUSED(fmi3GetClock, (fmi3Instance i, VRS, fmi3Clock value[]), ((void)vr, (void)count, (void)value), "clocks")
REFUSED(fmi3SetClock, (fmi3Instance i, VRS, const fmi3Clock value[]), ((void)vr, (void)count, (void)value), "clocks")
REFUSED(fmi3GetIntervalDecimal, (fmi3Instance i, VRS, fmi3Float64 v[], fmi3IntervalQualifier q[]),
        ((void)vr, (void)count, (void)v, (void)q), "clocks")
REFUSED(fmi3GetIntervalFraction, (fmi3Instance i, VRS, fmi3UInt64 c[], fmi3UInt64 r[], fmi3IntervalQualifier q[]),
        ((void)vr, (void)count, (void)c, (void)r, (void)q), "clocks")
REFUSED(fmi3GetShiftDecimal, (fmi3Instance i, VRS, fmi3Float64 v[]), ((void)vr, (void)count, (void)v), "clocks")
REFUSED(fmi3GetShiftFraction, (fmi3Instance i, VRS, fmi3UInt64 c[], fmi3UInt64 r[]), ((void)vr, (void)count, (void)c, (void)r), "clocks")
REFUSED(fmi3SetIntervalDecimal, (fmi3Instance i, VRS, const fmi3Float64 v[]), ((void)vr, (void)count, (void)v), "clocks")
REFUSED(fmi3SetIntervalFraction, (fmi3Instance i, VRS, const fmi3UInt64 c[], const fmi3UInt64 r[]), ((void)vr, (void)count, (void)c, (void)r), "clocks")
REFUSED(fmi3SetShiftDecimal, (fmi3Instance i, VRS, const fmi3Float64 v[]), ((void)vr, (void)count, (void)v), "clocks")
REFUSED(fmi3SetShiftFraction, (fmi3Instance i, VRS, const fmi3UInt64 c[], const fmi3UInt64 r[]), ((void)vr, (void)count, (void)c, (void)r), "clocks")
REFUSED(fmi3ActivateModelPartition, (fmi3Instance i, fmi3ValueReference clock, fmi3Float64 t), ((void)clock, (void)t), "scheduled execution")
REFUSED(fmi3EnterConfigurationMode, (fmi3Instance i), (void)0, "structural parameters")
REFUSED(fmi3ExitConfigurationMode, (fmi3Instance i), (void)0, "structural parameters")
REFUSED(fmi3EnterStepMode, (fmi3Instance i), (void)0, "event mode in co-simulation")
REFUSED(fmi3GetOutputDerivatives, (fmi3Instance i, VRS, const fmi3Int32 orders[], fmi3Float64 value[], size_t values),
        ((void)vr, (void)count, (void)orders, (void)value, (void)values), "derivatives of outputs")
REFUSED(fmi3GetNumberOfVariableDependencies, (fmi3Instance i, fmi3ValueReference vr, size_t *count),
        ((void)vr, (void)count), "dependencies element by element")
REFUSED(fmi3GetVariableDependencies, (fmi3Instance i, fmi3ValueReference vr, size_t of[], fmi3ValueReference by[], size_t elements[],
                                      fmi3DependencyKind kinds[], size_t count),
        ((void)vr, (void)of, (void)by, (void)elements, (void)kinds, (void)count), "dependencies element by element")
REFUSED(fmi3GetAdjointDerivative, (fmi3Instance i, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[], size_t nk,
                                   const fmi3Float64 seed[], size_t ns, fmi3Float64 slope[], size_t n),
        ((void)u, (void)nu, (void)k, (void)nk, (void)seed, (void)ns, (void)slope, (void)n), "adjoint derivatives")

/* -- state ------------------------------------------------------------------------------------------------------------ */

fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state)
{
    KNOWN(i);
    Snapshot *taken = snapshot(m);
    if (taken == NULL) return STATUS(refuse(m, "there is no memory for a state"));
    free(*state);
    *state = taken;
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state)
{
    KNOWN(i);
    const Snapshot *s = state;
    if (s == NULL) return STATUS(refuse(m, "there is no such state"));
    return STATUS(restore(m, s->bytes, s->size));
}

fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state)
{
    (void)i;
    if (state == NULL) return fmi3OK;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState state, size_t *size)
{
    KNOWN(i);
    const Snapshot *s = state;
    if (s == NULL) return STATUS(refuse(m, "there is no such state"));
    *size = s->size;
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    KNOWN(i);
    const Snapshot *s = state;
    if (s == NULL || size < s->size) return STATUS(refuse(m, "there is no room for the state"));
    memcpy(bytes, s->bytes, s->size);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    KNOWN(i);
    Snapshot *s = malloc(sizeof *s + size);
    if (s == NULL) return STATUS(refuse(m, "there is no memory for a state"));
    s->size = size;
    memcpy(s->bytes, bytes, size);
    *state = s;
    return fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance i, const fmi3ValueReference unknown[], size_t unknowns,
                                        const fmi3ValueReference known[], size_t knowns, const fmi3Float64 seed[], size_t seeds,
                                        fmi3Float64 slope[], size_t slopes_wanted)
{
    KNOWN(i);
    if (scalars(m, knowns, seeds) || scalars(m, unknowns, slopes_wanted) || directional_begin(m)) return fmi3Error;
    Direction d = {{0}, {0}, {0}, {0}};
    for (size_t k = 0; k < knowns; k++)
        if (direction_add(m, &d, known[k], seed[k])) return fmi3Error;
    direction_follow(m, &d);
    for (size_t k = 0; k < unknowns; k++)
        if (direction_read(m, &d, unknown[k], &slope[k])) return fmi3Error;
    return fmi3OK;
}

/* -- co-simulation ---------------------------------------------------------------------------------------------------- */

fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_state_before, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    KNOWN(i);
    (void)no_state_before;
    *event = *terminate = *early = fmi3False;
    const int refused = step(m, t, h);
    *last = m->time;
    return STATUS(refused);
}

/* -- model exchange --------------------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterEventMode(fmi3Instance i)
{
    KNOWN(i);
    if (in_phase(m, IN(CONTINUOUS) | IN(EVENT), "event mode is entered")) return fmi3Error;
    m->phase = EVENT;
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance i)
{
    KNOWN(i);
    return STATUS(in_phase(m, IN(INITIALIZATION) | IN(EVENT), "discrete states are evaluated"));
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance i, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *due, fmi3Float64 *when)
{
    KNOWN(i);
    double next = HUGE_VAL;
    if (in_phase(m, IN(EVENT), "discrete states are asked for") || update(m, &next)) return fmi3Error;
    *again = *terminate = *nominals = *values = fmi3False;
    *due = isfinite(next) ? fmi3True : fmi3False;
    *when = isfinite(next) ? next : 0.0;
    return fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance i)
{
    KNOWN(i);
    if (in_phase(m, IN(EVENT), "continuous-time mode is entered")) return fmi3Error;
    m->phase = CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance i, fmi3Boolean no_state_before, fmi3Boolean *event, fmi3Boolean *terminate)
{
    KNOWN(i);
    (void)no_state_before;
    if (in_phase(m, IN(CONTINUOUS), "an integrator step is completed") || completed(m)) return fmi3Error;
    *event = *terminate = fmi3False;
    return fmi3OK;
}

#define SOLVED (IN(INITIALIZATION) | IN(EVENT) | IN(CONTINUOUS))

fmi3Status fmi3SetTime(fmi3Instance i, fmi3Float64 time)
{
    KNOWN(i);
    return STATUS(set_time(m, time));
}

fmi3Status fmi3SetContinuousStates(fmi3Instance i, const fmi3Float64 x[], size_t count)
{
    KNOWN(i);
    if (in_phase(m, IN(EVENT) | IN(CONTINUOUS), "states are set")) return fmi3Error;
    return STATUS(set_states(m, x, count));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance i, fmi3Float64 dx[], size_t count)
{
    KNOWN(i);
    if (in_phase(m, SOLVED, "derivatives are asked for") || settled(m)) return fmi3Error;
    const int refused = get_rates(m, dx, count);
    return TRIED(refused);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance i, fmi3Float64 z[], size_t count)
{
    KNOWN(i);
    if (in_phase(m, SOLVED, "event indicators are asked for") || settled(m)) return fmi3Error;
    return STATUS(get_crossings(m, z, count));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance i, fmi3Float64 x[], size_t count)
{
    KNOWN(i);
    if (in_phase(m, SOLVED, "states are asked for") || settled(m)) return fmi3Error;
    return STATUS(get_states(m, x, count));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance i, fmi3Float64 nominal[], size_t count)
{
    KNOWN(i);
    if (count != STATES) return STATUS(refuse(m, "there are %d states, not %zu", STATES, count));
    for (size_t k = 0; k < count; k++) nominal[k] = 1.0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance i, size_t *count)
{
    KNOWN(i);
    (void)m;
    *count = KINKS;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance i, size_t *count)
{
    KNOWN(i);
    (void)m;
    *count = STATES;
    return fmi3OK;
}
