/* FMI 3.0 around an original. */
#define FMI(name) fmi3##name
#define GET(w, vr, count, value) (w)->f.GetFloat64((w)->component, vr, count, value, count)
#define SET(w, vr, count, value) BOTH(w, SetFloat64, vr, count, value, count)
#define SET_IN(w, instance, vr, count, value) (w)->f.SetFloat64(instance, vr, count, value, count)
#define GET_ALL(w, vr, count, value, values) (w)->f.GetFloat64((w)->component, vr, count, value, values)
#define SET_ALL(w, vr, count, value, values) BOTH(w, SetFloat64, vr, count, value, values)
#define GET_BOOLEANS(w, vr, count, value, values) (w)->f.GetBoolean((w)->component, vr, count, value, values)

/* What FMI 2.0 names otherwise. */
#define fmi3Component fmi3Instance
#define fmi3FMUstate fmi3FMUState
#define GetFMUstate GetFMUState
#define SetFMUstate SetFMUState
#define FreeFMUstate FreeFMUState
#define SerializedFMUstateSize SerializedFMUStateSize
#define SerializeFMUstate SerializeFMUState
#define DeSerializeFMUstate DeserializeFMUState
#define GetDerivatives GetContinuousStateDerivatives
#define fmi3GetFMUstate fmi3GetFMUState
#define fmi3SetFMUstate fmi3SetFMUState
#define fmi3FreeFMUstate fmi3FreeFMUState
#define fmi3SerializedFMUstateSize fmi3SerializedFMUStateSize
#define fmi3SerializeFMUstate fmi3SerializeFMUState
#define fmi3DeSerializeFMUstate fmi3DeserializeFMUState

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    int has_events, may_return; /* of co-simulation: event mode; early return */
} Host;

typedef struct {
    int stop;
    fmi3Boolean event, terminate, early;
    fmi3Float64 last;
} Ending;

typedef struct Wrapper Wrapper;
static fmi3Status one_step(Wrapper *w, double t, double h, fmi3Boolean no_state_before, Ending *end);

static void say(const Host *host, const char *message)
{
    if (host->log != NULL) host->log(host->environment, fmi3Error, "logStatusError", message);
}

/* Whether a step may end within: an event needs the host. */
static int may_divide(const Host *host)
{
    return !host->has_events || host->may_return;
}

static void dispose_host(Host *host)
{
    (void)host;
}

#include "wrapper.c"

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

/* A wrapper with the path of the original's resources in `inside`; NULL with the reason said. */
static Wrapper *prepared(Host host, int exchange, fmi3String resources, char **inside)
{
    Wrapper *w = created(host, exchange, resources);
    *inside = NULL;
    if (w == NULL) return NULL;
    if (w->f.FreeInstance == NULL || w->f.GetFloat64 == NULL || w->f.SetFloat64 == NULL) {
        refuse(w, "the original lacks functions of FMI 3.0");
        dispose(w);
        return NULL;
    }
    if (resources != NULL) *inside = resources_of_original(resources, "/");
    return w;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    const Host host = {environment, log, 0, 0};
    char *inside;
    Wrapper *w = prepared(host, 1, resources, &inside);
    if (w == NULL) return NULL;
    if (w->f.InstantiateModelExchange != NULL)
        for (int k = DIRECTIONS > 0; k >= 0; k--)
            *(k ? &w->second : &w->component) =
                w->f.InstantiateModelExchange(name, token_of_original(token), inside, visible, logging, environment, log);
    free(inside);
    return checked(w);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[],
                                         size_t count, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback between)
{
    const Host host = {environment, log, events, early};
    char *inside;
    Wrapper *w = prepared(host, 0, resources, &inside);
    if (w == NULL) return NULL;
    if (w->f.InstantiateCoSimulation != NULL)
        w->component = w->f.InstantiateCoSimulation(name, token_of_original(token), inside, visible, logging, events, early,
                                                    required, count, environment, log, between);
    free(inside);
    return checked(w);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    const Host host = {environment, log, 0, 0};
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock, (void)lock, (void)unlock;
    say(&host, "this FMU has no scheduled execution");
    return NULL;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance a0, fmi3Boolean has_tolerance, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop)
{
    KNOWN(a0);
    HAS(EnterInitializationMode);
    w->course.time = w->course.since = start;
    return after_entering_initialization(w, BOTH(w, EnterInitializationMode, has_tolerance, tolerance, start, has_stop, stop));
}

fmi3Status fmi3GetFloat64(fmi3Instance a0, const fmi3ValueReference vr[], size_t count, fmi3Float64 value[], size_t values)
{
    KNOWN(a0);
    return get_reals(w, vr, count, value, values);
}

fmi3Status fmi3SetFloat64(fmi3Instance a0, const fmi3ValueReference vr[], size_t count, const fmi3Float64 value[], size_t values)
{
    KNOWN(a0);
    return set_reals(w, vr, count, value, values);
}

fmi3Status fmi3GetBoolean(fmi3Instance a0, const fmi3ValueReference vr[], size_t count, fmi3Boolean value[], size_t values)
{
    KNOWN(a0);
    HAS(GetBoolean);
    return get_booleans(w, vr, count, value, values);
}

#define DERIVATIVE(name) \
    fmi3Status fmi3##name(fmi3Instance a0, const fmi3ValueReference unknowns[], size_t unknown, const fmi3ValueReference knowns[], \
                          size_t known, const fmi3Float64 seed[], size_t seeds, fmi3Float64 result[], size_t results) \
    { \
        KNOWN(a0); \
        HAS(name); \
        if (w->course.awake) return refuse(w, "directional derivatives are not available with active terms"); \
        return w->f.name(w->component, unknowns, unknown, knowns, known, seed, seeds, result, results); \
    }

DERIVATIVE(GetDirectionalDerivative)
DERIVATIVE(GetAdjointDerivative)

fmi3Status fmi3GetOutputDerivatives(fmi3Instance a0, const fmi3ValueReference vr[], size_t count, const fmi3Int32 order[],
                                    fmi3Float64 value[], size_t values)
{
    KNOWN(a0);
    HAS(GetOutputDerivatives);
    if (w->course.awake && READS) return refuse(w, "output derivatives are not available with active terms");
    return w->f.GetOutputDerivatives(w->component, vr, count, order, value, values);
}

static fmi3Status one_step(Wrapper *w, double t, double h, fmi3Boolean no_state_before, Ending *end)
{
    fmi3Boolean event = fmi3False;
    const fmi3Status status = w->f.DoStep(w->component, t, h, no_state_before, &event, &end->terminate, &end->early, &end->last);
    end->event = end->event || event;
    end->stop = end->terminate || end->early || (event && w->host.has_events);
    return status;
}

fmi3Status fmi3DoStep(fmi3Instance a0, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_state_before, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    KNOWN(a0);
    HAS(DoStep);
    Ending end = {0, fmi3False, fmi3False, fmi3False, t};
    const fmi3Status status = take_steps(w, t, h, no_state_before, &end);
    *event = end.event, *terminate = end.terminate, *last = end.last;
    *early = end.early || (end.stop && !end.terminate && w->host.may_return && end.last < t + h - 1e-9 * h);
    if (end.stop) w->course.time = w->course.since = end.last;
    return status;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance a0, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *due, fmi3Float64 *when)
{
    KNOWN(a0);
    HAS(UpdateDiscreteStates);
    double next;
    fmi3Status status = before_update(w);
    if (REFUSED(status)) return status;
    status = worse(status, BOTH(w, UpdateDiscreteStates, again, terminate, nominals, values, due, when));
    status = after_update(w, status, &next);
    if (!REFUSED(status) && isfinite(next) && !(*due && *when <= next)) *due = fmi3True, *when = next;
    return status;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance a0, fmi3Float64 dx[], size_t count)
{
    KNOWN(a0);
    HAS(GetContinuousStateDerivatives);
    return get_derivatives(w, dx, count);
}
