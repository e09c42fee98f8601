/* FMI 2.0 over an instance of a model. */
#include "model.h"
#include "fmi2Functions.h"

#define FMI(name) fmi2##name
#include "fmi.c"

typedef struct {
    fmi2CallbackFunctions callbacks;
    fmi2Component component;
    char name[];
} Host;

static void to_host(Instance *m, int warning, const char *message)
{
    Host *host = m->host;
    if (host->callbacks.logger == NULL) return;
    size_t size = 1;
    for (const char *c = message; *c; c++) size += *c == '%' ? 2 : 1; /* FMI takes a message for a format of printf */
    char *escaped = malloc(size), *at = escaped;
    if (escaped == NULL) return;
    for (const char *c = message; *c; c++) {
        if (*c == '%') *at++ = '%';
        *at++ = *c;
    }
    *at = '\0';
    host->callbacks.logger(host->callbacks.componentEnvironment, host->name, warning ? fmi2Warning : fmi2Error,
                           warning ? "logStatusWarning" : "logStatusError", escaped);
    free(escaped);
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    static const char unnamed[] = "instance";
    if (callbacks == NULL) return NULL;
    if (name == NULL || !name[0]) name = unnamed;
    Host *host = calloc(1, sizeof *host + strlen(name) + 1);
    if (host == NULL) return NULL;
    host->callbacks = *callbacks;
    strcpy(host->name, name);
    Instance *m = created(type == fmi2ModelExchange, host, to_host);
    if (m == NULL) {
        free(host);
        return NULL;
    }
    int refused = 0;
    if (guid == NULL || strcmp(guid, MODEL_GUID) != 0)
        refused = refuse(m, "the GUID is %s, but this library was built for %s", guid ? guid : "missing", MODEL_GUID);
    if (type == fmi2ModelExchange && !EXCHANGE)
        refused = refuse(m, "this FMU is for co-simulation only");
    if (refused) {
        dispose(m);
        free(host);
        return NULL;
    }
    return m;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop)
{
    KNOWN(c);
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return STATUS(start_at(m, start));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    KNOWN(c);
    return STATUS(enter_initialization(m));
}

#define ACCESS(name, type, of) \
    fmi2Status name(fmi2Component c, VRS, type value[]) \
    { \
        KNOWN(c); \
        return of(m, vr, count, value); \
    }

ACCESS(fmi2GetReal, fmi2Real, get_reals)
ACCESS(fmi2GetBoolean, fmi2Boolean, get_booleans)
ACCESS(fmi2GetString, fmi2String, get_strings)
ACCESS(fmi2SetReal, const fmi2Real, set_reals)
ACCESS(fmi2SetBoolean, const fmi2Boolean, set_booleans)
ACCESS(fmi2SetString, const fmi2String, set_strings)
REFUSED(fmi2GetInteger, (fmi2Component c, VRS, fmi2Integer value[]), ((void)vr, (void)value), count > 0, "there is no Integer")
REFUSED(fmi2SetInteger, (fmi2Component c, VRS, const fmi2Integer value[]), ((void)vr, (void)value), count > 0, "there is no Integer")
REFUSED(fmi2SetRealInputDerivatives, (fmi2Component c, VRS, const fmi2Integer order[], const fmi2Real value[]),
        ((void)vr, (void)order, (void)value), count > 0, "inputs are constant during a step")
REFUSED(fmi2GetRealOutputDerivatives, (fmi2Component c, VRS, const fmi2Integer order[], fmi2Real value[]),
        ((void)vr, (void)order, (void)value), count > 0, "output derivatives are not supported")
REFUSED(fmi2CancelStep, (fmi2Component c), (void)0, 1, "no step is pending")

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t unknowns,
                                        const fmi2ValueReference known[], size_t knowns, const fmi2Real change[], fmi2Real slope[])
{
    KNOWN(c);
    return directional(m, unknown, unknowns, known, knowns, change, slope);
}

/* -- co-simulation -------------------------------------------------------------------------------------------------- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_state_before)
{
    KNOWN(c);
    (void)no_state_before;
    return STATUS(step(m, t, h));
}

static fmi2Status no_status(Instance *m)
{
    refuse(m, "no step is pending");
    return fmi2Discard;
}

#define PENDING(name, type) \
    fmi2Status name(fmi2Component c, const fmi2StatusKind kind, type *value) \
    { \
        KNOWN(c); \
        (void)kind, (void)value; \
        return no_status(m); \
    }

PENDING(fmi2GetStatus, fmi2Status)
PENDING(fmi2GetIntegerStatus, fmi2Integer)
PENDING(fmi2GetStringStatus, fmi2String)

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    KNOWN(c);
    if (kind != fmi2LastSuccessfulTime) return no_status(m);
    *value = m->time;
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    KNOWN(c);
    if (kind != fmi2Terminated) return no_status(m);
    *value = fmi2False;
    return fmi2OK;
}

/* -- model exchange ------------------------------------------------------------------------------------------------- */

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    KNOWN(c);
    double next = HUGE_VAL;
    if (in_phase(m, IN(EVENT), "discrete states are requested") || update(m, &next)) return fmi2Error;
    info->newDiscreteStatesNeeded = info->terminateSimulation = fmi2False;
    info->nominalsOfContinuousStatesChanged = info->valuesOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = isfinite(next) ? fmi2True : fmi2False;
    info->nextEventTime = isfinite(next) ? next : 0.0;
    return fmi2OK;
}
