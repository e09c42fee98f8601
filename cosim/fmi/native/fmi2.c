/* FMI 2.0 over an instance of a model. */
#include "model.h"
#include "fmi2Functions.h"

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

#define STATUS(refused) ((refused) ? fmi2Error : fmi2OK)
#define TRIED(refused) ((refused) == UNDEFINED ? fmi2Discard : STATUS(refused)) /* a solver may try another step */
#define KNOWN(component) \
    Instance *m = component; \
    if (m == NULL) return fmi2Error

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    KNOWN(c);
    (void)m, (void)on, (void)count, (void)categories; /* errors and warnings are always said, nothing else ever is */
    return fmi2OK;
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
        refused = refuse(m, "the GUID is %s; this library is of %s", guid ? guid : "missing", MODEL_GUID);
    if (type == fmi2ModelExchange && !EXCHANGE)
        refused = refuse(m, "this FMU is for co-simulation only");
    if (refused) {
        dispose(m);
        free(host);
        return NULL;
    }
    return m;
}

void fmi2FreeInstance(fmi2Component c)
{
    Instance *m = c;
    if (m == NULL) return;
    free(m->host);
    dispose(m);
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

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    KNOWN(c);
    return STATUS(exit_initialization(m));
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    KNOWN(c);
    if (in_phase(m, IN(STEP) | IN(EVENT) | IN(CONTINUOUS), "it is terminated")) return fmi2Error;
    m->phase = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    KNOWN(c);
    reset(m);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Real value[])
{
    KNOWN(c);
    if (readable(m)) return fmi2Error;
    for (size_t k = 0; k < count; k++) {
        if (vr[k] < VARIABLES && variables[vr[k]].kind == REAL) value[k] = m->values[vr[k]];
        else if (get_local(m, vr[k], &value[k])) return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Integer value[])
{
    KNOWN(c);
    (void)vr, (void)value;
    return STATUS(count > 0 && refuse(m, "there is no Integer"));
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Boolean value[])
{
    KNOWN(c);
    for (size_t k = 0; k < count; k++) {
        if (is_kind(m, vr[k], BOOLEAN)) return fmi2Error;
        value[k] = m->values[vr[k]] != 0.0;
    }
    return fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2String value[])
{
    KNOWN(c);
    for (size_t k = 0; k < count; k++) {
        if (is_kind(m, vr[k], STRING)) return fmi2Error;
        value[k] = m->text[(size_t)variables[vr[k]].start];
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Real value[])
{
    KNOWN(c);
    for (size_t k = 0; k < count; k++)
        if (set_number(m, vr[k], REAL, value[k])) return fmi2Error;
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Integer value[])
{
    KNOWN(c);
    (void)vr, (void)value;
    return STATUS(count > 0 && refuse(m, "there is no Integer"));
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Boolean value[])
{
    KNOWN(c);
    for (size_t k = 0; k < count; k++)
        if (set_number(m, vr[k], BOOLEAN, value[k] ? 1.0 : 0.0)) return fmi2Error;
    return fmi2OK;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2String value[])
{
    KNOWN(c);
    for (size_t k = 0; k < count; k++)
        if (set_text(m, vr[k], value[k])) return fmi2Error;
    return fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    KNOWN(c);
    Snapshot *taken = snapshot(m);
    if (taken == NULL) return STATUS(refuse(m, "there is no memory for a state"));
    free(*state);
    *state = taken;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    KNOWN(c);
    const Snapshot *s = state;
    if (s == NULL) return STATUS(refuse(m, "there is no such state"));
    return STATUS(restore(m, s->bytes, s->size));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    if (state == NULL) return fmi2OK;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    KNOWN(c);
    const Snapshot *s = state;
    if (s == NULL) return STATUS(refuse(m, "there is no such state"));
    *size = s->size;
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    KNOWN(c);
    const Snapshot *s = state;
    if (s == NULL || size < s->size) return STATUS(refuse(m, "there is no room for the state"));
    memcpy(bytes, s->bytes, s->size);
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    KNOWN(c);
    Snapshot *s = malloc(sizeof *s + size);
    if (s == NULL) return STATUS(refuse(m, "there is no memory for a state"));
    s->size = size;
    memcpy(s->bytes, bytes, size);
    *state = s;
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t unknowns,
                                        const fmi2ValueReference known[], size_t knowns, const fmi2Real change[], fmi2Real slope[])
{
    KNOWN(c);
    if (directional_begin(m)) return fmi2Error;
    Direction d = {{0}, {0}, {0}, {0}};
    for (size_t k = 0; k < knowns; k++)
        if (direction_add(m, &d, known[k], change[k])) return fmi2Error;
    direction_follow(m, &d);
    for (size_t k = 0; k < unknowns; k++)
        if (direction_read(m, &d, unknown[k], &slope[k])) return fmi2Error;
    return fmi2OK;
}

/* -- co-simulation -------------------------------------------------------------------------------------------------- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_state_before)
{
    KNOWN(c);
    (void)no_state_before;
    return STATUS(step(m, t, h));
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    KNOWN(c);
    return STATUS(refuse(m, "no step is pending"));
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Integer order[], const fmi2Real value[])
{
    KNOWN(c);
    (void)vr, (void)order, (void)value;
    return STATUS(count > 0 && refuse(m, "inputs are held over a step"));
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Integer order[], fmi2Real value[])
{
    KNOWN(c);
    (void)vr, (void)order, (void)value;
    return STATUS(count > 0 && refuse(m, "outputs have no derivatives here"));
}

static fmi2Status no_status(Instance *m)
{
    refuse(m, "no step is pending");
    return fmi2Discard;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    KNOWN(c);
    (void)kind, (void)value;
    return no_status(m);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    KNOWN(c);
    if (kind != fmi2LastSuccessfulTime) return no_status(m);
    *value = m->time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    KNOWN(c);
    (void)kind, (void)value;
    return no_status(m);
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    KNOWN(c);
    if (kind != fmi2Terminated) return no_status(m);
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    KNOWN(c);
    (void)kind, (void)value;
    return no_status(m);
}

/* -- model exchange ------------------------------------------------------------------------------------------------- */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    KNOWN(c);
    if (in_phase(m, IN(CONTINUOUS) | IN(EVENT), "event mode is entered")) return fmi2Error;
    m->phase = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    KNOWN(c);
    double next = HUGE_VAL;
    if (in_phase(m, IN(EVENT), "discrete states are asked for") || update(m, &next)) return fmi2Error;
    info->newDiscreteStatesNeeded = info->terminateSimulation = fmi2False;
    info->nominalsOfContinuousStatesChanged = info->valuesOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = isfinite(next) ? fmi2True : fmi2False;
    info->nextEventTime = isfinite(next) ? next : 0.0;
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    KNOWN(c);
    if (in_phase(m, IN(EVENT), "continuous-time mode is entered")) return fmi2Error;
    m->phase = CONTINUOUS;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_state_before, fmi2Boolean *event, fmi2Boolean *terminate)
{
    KNOWN(c);
    (void)no_state_before;
    if (in_phase(m, IN(CONTINUOUS), "an integrator step is completed") || completed(m)) return fmi2Error;
    *event = *terminate = fmi2False;
    return fmi2OK;
}

#define SOLVED (IN(INITIALIZATION) | IN(EVENT) | IN(CONTINUOUS))

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    KNOWN(c);
    return STATUS(set_time(m, time));
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, IN(EVENT) | IN(CONTINUOUS), "states are set")) return fmi2Error;
    return STATUS(set_states(m, x, count));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, SOLVED, "derivatives are asked for") || settled(m)) return fmi2Error;
    const int refused = get_rates(m, dx, count);
    return TRIED(refused);
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, SOLVED, "event indicators are asked for") || settled(m)) return fmi2Error;
    return STATUS(get_crossings(m, z, count));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, SOLVED, "states are asked for") || settled(m)) return fmi2Error;
    return STATUS(get_states(m, x, count));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t count)
{
    KNOWN(c);
    if (count != STATES) return STATUS(refuse(m, "there are %d states, not %zu", STATES, count));
    for (size_t k = 0; k < count; k++) nominal[k] = 1.0;
    return fmi2OK;
}
