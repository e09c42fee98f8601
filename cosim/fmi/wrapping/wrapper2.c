/* FMI 2.0 around an original. */
#define FMI(name) fmi2##name
#define GET(w, vr, count, value) (w)->f.GetReal((w)->component, vr, count, value)
#define SET(w, vr, count, value) BOTH(w, SetReal, vr, count, value)
#define SET_IN(w, instance, vr, count, value) (w)->f.SetReal(instance, vr, count, value)
#define GET_ALL(w, vr, count, value, values) GET(w, vr, count, value)
#define SET_ALL(w, vr, count, value, values) SET(w, vr, count, value)
#define GET_BOOLEANS(w, vr, count, value, values) (w)->f.GetBoolean((w)->component, vr, count, value)

typedef struct {
    fmi2CallbackFunctions callbacks;
    char *name;
} Host;

typedef struct {
    int stop;
} Ending;

typedef struct Wrapper Wrapper;
static fmi2Status one_step(Wrapper *w, double t, double h, fmi2Boolean no_state_before, Ending *end);

static void say(const Host *host, const char *message)
{
    char format[2 * 512], *at = format; /* FMI takes a message for a format of printf */
    if (host->callbacks.logger == NULL) return;
    for (const char *c = message; *c && at < format + sizeof format - 2; c++) {
        if (*c == '%') *at++ = '%';
        *at++ = *c;
    }
    *at = '\0';
    host->callbacks.logger(host->callbacks.componentEnvironment, host->name, fmi2Error, "logStatusError", format);
}

static int may_divide(const Host *host)
{
    (void)host;
    return 1;
}

static void dispose_host(Host *host)
{
    free(host->name);
}

#include "wrapper.c"

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    Host host;
    if (callbacks == NULL) return NULL;
    host.callbacks = *callbacks;
    host.name = malloc(strlen(name == NULL ? "" : name) + 1);
    if (host.name == NULL) return NULL;
    strcpy(host.name, name == NULL ? "" : name);
    Wrapper *w = created(host, type == fmi2ModelExchange, resources);
    if (w == NULL) return NULL;
    char *inside = resources == NULL ? NULL : resources_of_original(resources, "");
    if (w->f.Instantiate != NULL && w->f.FreeInstance != NULL && w->f.GetReal != NULL && w->f.SetReal != NULL)
        for (int k = DIRECTIONS && w->exchange; k >= 0; k--)
            *(k ? &w->second : &w->component) = w->f.Instantiate(name, type, token_of_original(guid), inside, callbacks, visible, logging);
    else refuse(w, "the original lacks functions of FMI 2.0");
    free(inside);
    return checked(w);
}

fmi2Status fmi2SetupExperiment(fmi2Component a0, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop)
{
    KNOWN(a0);
    HAS(SetupExperiment);
    w->course.time = w->course.since = start;
    return BOTH(w, SetupExperiment, has_tolerance, tolerance, start, has_stop, stop);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component a0)
{
    KNOWN(a0);
    HAS(EnterInitializationMode);
    return after_entering_initialization(w, BOTH(w, EnterInitializationMode));
}

fmi2Status fmi2GetReal(fmi2Component a0, const fmi2ValueReference vr[], size_t count, fmi2Real value[])
{
    KNOWN(a0);
    return get_reals(w, vr, count, value, count);
}

fmi2Status fmi2SetReal(fmi2Component a0, const fmi2ValueReference vr[], size_t count, const fmi2Real value[])
{
    KNOWN(a0);
    return set_reals(w, vr, count, value, count);
}

fmi2Status fmi2GetBoolean(fmi2Component a0, const fmi2ValueReference vr[], size_t count, fmi2Boolean value[])
{
    KNOWN(a0);
    HAS(GetBoolean);
    return get_booleans(w, vr, count, value, count);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component a0, const fmi2ValueReference unknown[], size_t unknowns,
                                        const fmi2ValueReference known[], size_t knowns, const fmi2Real change[], fmi2Real slope[])
{
    KNOWN(a0);
    HAS(GetDirectionalDerivative);
    if (w->course.awake) return refuse(w, "directional derivatives are not available with active terms");
    return w->f.GetDirectionalDerivative(w->component, unknown, unknowns, known, knowns, change, slope);
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component a0, const fmi2ValueReference vr[], size_t count, const fmi2Integer order[], const fmi2Real value[])
{
    KNOWN(a0);
    HAS(SetRealInputDerivatives);
    if (w->course.awake && ACTS) return refuse(w, "inputs are constant during a step with active terms");
    return w->f.SetRealInputDerivatives(w->component, vr, count, order, value);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component a0, const fmi2ValueReference vr[], size_t count, const fmi2Integer order[], fmi2Real value[])
{
    KNOWN(a0);
    HAS(GetRealOutputDerivatives);
    if (w->course.awake && READS) return refuse(w, "output derivatives are not available with active terms");
    return w->f.GetRealOutputDerivatives(w->component, vr, count, order, value);
}

static fmi2Status one_step(Wrapper *w, double t, double h, fmi2Boolean no_state_before, Ending *end)
{
    (void)end;
    return w->f.DoStep(w->component, t, h, no_state_before);
}

fmi2Status fmi2DoStep(fmi2Component a0, fmi2Real t, fmi2Real h, fmi2Boolean no_state_before)
{
    KNOWN(a0);
    HAS(DoStep);
    Ending end = {0};
    return take_steps(w, t, h, no_state_before, &end);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component a0, fmi2EventInfo *info)
{
    KNOWN(a0);
    HAS(NewDiscreteStates);
    double next;
    fmi2Status status = before_update(w);
    if (REFUSED(status)) return status;
    status = after_update(w, worse(status, BOTH(w, NewDiscreteStates, info)), &next);
    if (!REFUSED(status) && isfinite(next) && !(info->nextEventTimeDefined && info->nextEventTime <= next)) {
        info->nextEventTimeDefined = fmi2True;
        info->nextEventTime = next;
    }
    return status;
}

fmi2Status fmi2GetDerivatives(fmi2Component a0, fmi2Real dx[], size_t count)
{
    KNOWN(a0);
    HAS(GetDerivatives);
    return get_derivatives(w, dx, count);
}
