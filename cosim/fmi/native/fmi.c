/* What FMI 2.0 and FMI 3.0 have alike, over an instance of a model.
 *
 * Defined above this text: FMI(name), which puts fmi2 or fmi3 before a name of FMI 2.0. FMI's status is returned. */
#define STATUS(refused) ((refused) ? FMI(Error) : FMI(OK))
#define TRIED(refused) ((refused) == UNDEFINED ? FMI(Discard) : STATUS(refused)) /* a solver may try another step */
#define KNOWN(instance) \
    Instance *m = instance; \
    if (m == NULL) return FMI(Error)
#define VRS const FMI(ValueReference) vr[], size_t count

/* A function that this FMU refuses where a condition holds; its instance is `c`. */
#define REFUSED(name, parameters, unused, condition, reason) \
    FMI(Status) name parameters \
    { \
        KNOWN(c); \
        unused; \
        return STATUS((condition) && refuse(m, reason)); \
    }

const char *FMI(GetVersion)(void)
{
    return FMI(Version);
}

FMI(Status) FMI(SetDebugLogging)(FMI(Component) c, FMI(Boolean) on, size_t count, const FMI(String) categories[])
{
    KNOWN(c);
    (void)m, (void)on, (void)count, (void)categories; /* errors and warnings are always said, nothing else ever is */
    return FMI(OK);
}

void FMI(FreeInstance)(FMI(Component) c)
{
    Instance *m = c;
    if (m == NULL) return;
    free(m->host);
    dispose(m);
}

FMI(Status) FMI(ExitInitializationMode)(FMI(Component) c)
{
    KNOWN(c);
    return STATUS(exit_initialization(m));
}

FMI(Status) FMI(Terminate)(FMI(Component) c)
{
    KNOWN(c);
    if (in_phase(m, IN(STEP) | IN(EVENT) | IN(CONTINUOUS), "it is terminated")) return FMI(Error);
    m->phase = TERMINATED;
    return FMI(OK);
}

FMI(Status) FMI(Reset)(FMI(Component) c)
{
    KNOWN(c);
    reset(m);
    return FMI(OK);
}

/* -- values --------------------------------------------------------------------------------------------------------- */

static FMI(Status) get_reals(Instance *m, VRS, double value[])
{
    if (make_readable(m)) return FMI(Error);
    for (size_t k = 0; k < count; k++) {
        if (vr[k] < VARIABLES && variables[vr[k]].kind == REAL) value[k] = m->values[vr[k]];
        else if (get_local(m, vr[k], &value[k])) return FMI(Error);
    }
    return FMI(OK);
}

static FMI(Status) get_booleans(Instance *m, VRS, FMI(Boolean) value[])
{
    for (size_t k = 0; k < count; k++) {
        if (is_kind(m, vr[k], BOOLEAN)) return FMI(Error);
        value[k] = m->values[vr[k]] != 0.0;
    }
    return FMI(OK);
}

static FMI(Status) get_strings(Instance *m, VRS, FMI(String) value[])
{
    for (size_t k = 0; k < count; k++) {
        if (is_kind(m, vr[k], STRING)) return FMI(Error);
        value[k] = m->text[(size_t)variables[vr[k]].start];
    }
    return FMI(OK);
}

static FMI(Status) set_reals(Instance *m, VRS, const double value[])
{
    for (size_t k = 0; k < count; k++)
        if (set_number(m, vr[k], REAL, value[k])) return FMI(Error);
    return FMI(OK);
}

static FMI(Status) set_booleans(Instance *m, VRS, const FMI(Boolean) value[])
{
    for (size_t k = 0; k < count; k++)
        if (set_number(m, vr[k], BOOLEAN, value[k] ? 1.0 : 0.0)) return FMI(Error);
    return FMI(OK);
}

static FMI(Status) set_strings(Instance *m, VRS, const FMI(String) value[])
{
    for (size_t k = 0; k < count; k++)
        if (set_text(m, vr[k], value[k])) return FMI(Error);
    return FMI(OK);
}

static FMI(Status) directional(Instance *m, const FMI(ValueReference) unknown[], size_t unknowns,
                               const FMI(ValueReference) known[], size_t knowns, const double change[], double slope[])
{
    if (directional_begin(m)) return FMI(Error);
    Direction d = {{0}, {0}, {0}, {0}};
    for (size_t k = 0; k < knowns; k++)
        if (direction_add(m, &d, known[k], change[k])) return FMI(Error);
    direction_follow(m, &d);
    for (size_t k = 0; k < unknowns; k++)
        if (direction_read(m, &d, unknown[k], &slope[k])) return FMI(Error);
    return FMI(OK);
}

/* -- state ---------------------------------------------------------------------------------------------------------- */

FMI(Status) FMI(GetFMUstate)(FMI(Component) c, FMI(FMUstate) *state)
{
    KNOWN(c);
    Snapshot *taken = snapshot(m);
    if (taken == NULL) return STATUS(refuse(m, "not enough memory for a state"));
    free(*state);
    *state = taken;
    return FMI(OK);
}

FMI(Status) FMI(SetFMUstate)(FMI(Component) c, FMI(FMUstate) state)
{
    KNOWN(c);
    const Snapshot *s = state;
    if (s == NULL) return STATUS(refuse(m, "there is no such state"));
    return STATUS(restore(m, s->bytes, s->size));
}

FMI(Status) FMI(FreeFMUstate)(FMI(Component) c, FMI(FMUstate) *state)
{
    (void)c;
    if (state == NULL) return FMI(OK);
    free(*state);
    *state = NULL;
    return FMI(OK);
}

FMI(Status) FMI(SerializedFMUstateSize)(FMI(Component) c, FMI(FMUstate) state, size_t *size)
{
    KNOWN(c);
    const Snapshot *s = state;
    if (s == NULL) return STATUS(refuse(m, "there is no such state"));
    *size = s->size;
    return FMI(OK);
}

FMI(Status) FMI(SerializeFMUstate)(FMI(Component) c, FMI(FMUstate) state, FMI(Byte) bytes[], size_t size)
{
    KNOWN(c);
    const Snapshot *s = state;
    if (s == NULL || size < s->size) return STATUS(refuse(m, "the buffer is too small for the state"));
    memcpy(bytes, s->bytes, s->size);
    return FMI(OK);
}

FMI(Status) FMI(DeSerializeFMUstate)(FMI(Component) c, const FMI(Byte) bytes[], size_t size, FMI(FMUstate) *state)
{
    KNOWN(c);
    Snapshot *s = malloc(sizeof *s + size);
    if (s == NULL) return STATUS(refuse(m, "not enough memory for a state"));
    s->size = size;
    memcpy(s->bytes, bytes, size);
    *state = s;
    return FMI(OK);
}

/* -- model exchange ------------------------------------------------------------------------------------------------- */

#define SOLVED (IN(INITIALIZATION) | IN(EVENT) | IN(CONTINUOUS))

FMI(Status) FMI(EnterEventMode)(FMI(Component) c)
{
    KNOWN(c);
    if (in_phase(m, IN(CONTINUOUS) | IN(EVENT), "event mode is entered")) return FMI(Error);
    m->phase = EVENT;
    return FMI(OK);
}

FMI(Status) FMI(EnterContinuousTimeMode)(FMI(Component) c)
{
    KNOWN(c);
    if (in_phase(m, IN(EVENT), "continuous-time mode is entered")) return FMI(Error);
    m->phase = CONTINUOUS;
    return FMI(OK);
}

FMI(Status) FMI(CompletedIntegratorStep)(FMI(Component) c, FMI(Boolean) no_state_before, FMI(Boolean) *event, FMI(Boolean) *terminate)
{
    KNOWN(c);
    (void)no_state_before;
    if (in_phase(m, IN(CONTINUOUS), "an integrator step is completed") || complete_step(m)) return FMI(Error);
    *event = *terminate = FMI(False);
    return FMI(OK);
}

FMI(Status) FMI(SetTime)(FMI(Component) c, double time)
{
    KNOWN(c);
    return STATUS(set_time(m, time));
}

FMI(Status) FMI(SetContinuousStates)(FMI(Component) c, const double x[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, IN(EVENT) | IN(CONTINUOUS), "states are set")) return FMI(Error);
    return STATUS(set_states(m, x, count));
}

FMI(Status) FMI(GetDerivatives)(FMI(Component) c, double dx[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, SOLVED, "derivatives are requested") || settle(m)) return FMI(Error);
    const int refused = get_rates(m, dx, count);
    return TRIED(refused);
}

FMI(Status) FMI(GetEventIndicators)(FMI(Component) c, double z[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, SOLVED, "event indicators are requested") || settle(m)) return FMI(Error);
    return STATUS(get_crossings(m, z, count));
}

FMI(Status) FMI(GetContinuousStates)(FMI(Component) c, double x[], size_t count)
{
    KNOWN(c);
    if (in_phase(m, SOLVED, "states are requested") || settle(m)) return FMI(Error);
    return STATUS(get_states(m, x, count));
}

FMI(Status) FMI(GetNominalsOfContinuousStates)(FMI(Component) c, double nominal[], size_t count)
{
    KNOWN(c);
    if (count != STATES) return STATUS(refuse(m, "there are %d states, not %zu", STATES, count));
    for (size_t k = 0; k < count; k++) nominal[k] = 1.0;
    return FMI(OK);
}
