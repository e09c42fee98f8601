/* FMI 3.0 over an instance of a model. */
#include "model.h"
#include "fmi3Functions.h"

#define FMI(name) fmi3##name
/* Of what FMI 2.0 names otherwise. */
#define fmi3Component fmi3Instance
#define fmi3FMUstate fmi3FMUState
#define fmi3GetFMUstate fmi3GetFMUState
#define fmi3SetFMUstate fmi3SetFMUState
#define fmi3FreeFMUstate fmi3FreeFMUState
#define fmi3SerializedFMUstateSize fmi3SerializedFMUStateSize
#define fmi3SerializeFMUstate fmi3SerializeFMUState
#define fmi3DeSerializeFMUstate fmi3DeserializeFMUState
#define fmi3GetDerivatives fmi3GetContinuousStateDerivatives
#include "fmi.c"

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

static fmi3Instance instantiate(int exchange, fmi3String token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    Host *host = calloc(1, sizeof *host);
    if (host == NULL) return NULL;
    host->environment = environment;
    host->log = log;
    Instance *m = created(exchange, host, to_host);
    int refused = m == NULL;
    if (m != NULL && (token == NULL || strcmp(token, MODEL_GUID) != 0))
        refused = refuse(m, "the instantiation token is %s, but this library was built for %s", token ? token : "missing", MODEL_GUID);
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
    return instantiate(1, token, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[],
                                         size_t count, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback between)
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)count, (void)between;
    return instantiate(0, token, environment, log);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock, (void)lock, (void)unlock;
    if (log != NULL) log(environment, fmi3Error, "logStatusError", "this FMU has no scheduled execution");
    return NULL;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop)
{
    KNOWN(c);
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return STATUS(start_at(m, start) || enter_initialization(m));
}

/* -- values ----------------------------------------------------------------------------------------------------------- */

static int check_scalars(Instance *m, size_t count, size_t values)
{
    return count != values && refuse(m, "%zu variables and %zu values; all variables are scalars", count, values);
}

#define ACCESS(name, type, of) \
    fmi3Status name(fmi3Instance c, VRS, type value[], size_t values) \
    { \
        KNOWN(c); \
        return check_scalars(m, count, values) ? fmi3Error : of(m, vr, count, value); \
    }

ACCESS(fmi3GetFloat64, fmi3Float64, get_reals)
ACCESS(fmi3GetBoolean, fmi3Boolean, get_booleans)
ACCESS(fmi3GetString, fmi3String, get_strings)
ACCESS(fmi3SetFloat64, const fmi3Float64, set_reals)
ACCESS(fmi3SetBoolean, const fmi3Boolean, set_booleans)
ACCESS(fmi3SetString, const fmi3String, set_strings)

/* Types of which no variable is. */
#define NO_VARIABLES(type) \
    REFUSED(fmi3Get##type, (fmi3Instance c, VRS, fmi3##type value[], size_t values), \
            ((void)vr, (void)value, (void)values), count > 0, "there is no " #type) \
    REFUSED(fmi3Set##type, (fmi3Instance c, VRS, const fmi3##type value[], size_t values), \
            ((void)vr, (void)value, (void)values), count > 0, "there is no " #type)

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
#define HAS_NO(name, parameters, unused, what) REFUSED(name, parameters, unused, 1, "this FMU has no " what)

HAS_NO(fmi3GetBinary, (fmi3Instance c, VRS, size_t sizes[], fmi3Binary value[], size_t values),
        ((void)vr, (void)count, (void)sizes, (void)value, (void)values), "Binary")
HAS_NO(fmi3SetBinary, (fmi3Instance c, VRS, const size_t sizes[], const fmi3Binary value[], size_t values),
        ((void)vr, (void)count, (void)sizes, (void)value, (void)values), "Binary")
HAS_NO(fmi3GetClock, (fmi3Instance c, VRS, fmi3Clock value[]), ((void)vr, (void)count, (void)value), "clocks")
HAS_NO(fmi3SetClock, (fmi3Instance c, VRS, const fmi3Clock value[]), ((void)vr, (void)count, (void)value), "clocks")
HAS_NO(fmi3GetIntervalDecimal, (fmi3Instance c, VRS, fmi3Float64 v[], fmi3IntervalQualifier q[]),
        ((void)vr, (void)count, (void)v, (void)q), "clocks")
HAS_NO(fmi3GetIntervalFraction, (fmi3Instance c, VRS, fmi3UInt64 n[], fmi3UInt64 r[], fmi3IntervalQualifier q[]),
        ((void)vr, (void)count, (void)n, (void)r, (void)q), "clocks")
HAS_NO(fmi3GetShiftDecimal, (fmi3Instance c, VRS, fmi3Float64 v[]), ((void)vr, (void)count, (void)v), "clocks")
HAS_NO(fmi3GetShiftFraction, (fmi3Instance c, VRS, fmi3UInt64 n[], fmi3UInt64 r[]), ((void)vr, (void)count, (void)n, (void)r), "clocks")
HAS_NO(fmi3SetIntervalDecimal, (fmi3Instance c, VRS, const fmi3Float64 v[]), ((void)vr, (void)count, (void)v), "clocks")
HAS_NO(fmi3SetIntervalFraction, (fmi3Instance c, VRS, const fmi3UInt64 n[], const fmi3UInt64 r[]), ((void)vr, (void)count, (void)n, (void)r), "clocks")
HAS_NO(fmi3SetShiftDecimal, (fmi3Instance c, VRS, const fmi3Float64 v[]), ((void)vr, (void)count, (void)v), "clocks")
HAS_NO(fmi3SetShiftFraction, (fmi3Instance c, VRS, const fmi3UInt64 n[], const fmi3UInt64 r[]), ((void)vr, (void)count, (void)n, (void)r), "clocks")
HAS_NO(fmi3ActivateModelPartition, (fmi3Instance c, fmi3ValueReference clock, fmi3Float64 t), ((void)clock, (void)t), "scheduled execution")
HAS_NO(fmi3EnterConfigurationMode, (fmi3Instance c), (void)0, "structural parameters")
HAS_NO(fmi3ExitConfigurationMode, (fmi3Instance c), (void)0, "structural parameters")
HAS_NO(fmi3EnterStepMode, (fmi3Instance c), (void)0, "event mode in co-simulation")
HAS_NO(fmi3GetOutputDerivatives, (fmi3Instance c, VRS, const fmi3Int32 orders[], fmi3Float64 value[], size_t values),
        ((void)vr, (void)count, (void)orders, (void)value, (void)values), "derivatives of outputs")
HAS_NO(fmi3GetNumberOfVariableDependencies, (fmi3Instance c, fmi3ValueReference vr, size_t *count),
        ((void)vr, (void)count), "dependencies element by element")
HAS_NO(fmi3GetVariableDependencies, (fmi3Instance c, fmi3ValueReference vr, size_t of[], fmi3ValueReference by[], size_t elements[],
                                      fmi3DependencyKind kinds[], size_t count),
        ((void)vr, (void)of, (void)by, (void)elements, (void)kinds, (void)count), "dependencies element by element")
HAS_NO(fmi3GetAdjointDerivative, (fmi3Instance c, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[], size_t nk,
                                   const fmi3Float64 seed[], size_t ns, fmi3Float64 slope[], size_t n),
        ((void)u, (void)nu, (void)k, (void)nk, (void)seed, (void)ns, (void)slope, (void)n), "adjoint derivatives")

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknown[], size_t unknowns,
                                        const fmi3ValueReference known[], size_t knowns, const fmi3Float64 seed[], size_t seeds,
                                        fmi3Float64 slope[], size_t slopes_wanted)
{
    KNOWN(c);
    if (check_scalars(m, knowns, seeds) || check_scalars(m, unknowns, slopes_wanted)) return fmi3Error;
    return directional(m, unknown, unknowns, known, knowns, seed, slope);
}

/* -- co-simulation ---------------------------------------------------------------------------------------------------- */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_state_before, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    KNOWN(c);
    (void)no_state_before;
    *event = *terminate = *early = fmi3False;
    const int refused = step(m, t, h);
    *last = m->time;
    return STATUS(refused);
}

/* -- model exchange --------------------------------------------------------------------------------------------------- */

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    KNOWN(c);
    return STATUS(in_phase(m, IN(INITIALIZATION) | IN(EVENT), "discrete states are evaluated"));
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *due, fmi3Float64 *when)
{
    KNOWN(c);
    double next = HUGE_VAL;
    if (in_phase(m, IN(EVENT), "discrete states are requested") || update(m, &next)) return fmi3Error;
    *again = *terminate = *nominals = *values = fmi3False;
    *due = isfinite(next) ? fmi3True : fmi3False;
    *when = isfinite(next) ? next : 0.0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *count)
{
    KNOWN(c);
    (void)m;
    *count = KINKS;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *count)
{
    KNOWN(c);
    (void)m;
    *count = STATES;
    return fmi3OK;
}
