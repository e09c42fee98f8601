/* A wrapped FMU: every call goes to an instance of the original, and the terms change what goes in and comes out.
 *
 * config.h, printed for each FMU, says how large it is and which variables the terms act on; terms.c holds the terms. FMI
 * 2.0 and 3.0 have this text in common. Defined above it: FMI(name), which puts fmi2 or fmi3 before a name; the calls GET,
 * SET, GET_ALL, SET_ALL of real variables of the original; one_step. */
#include <math.h>
#include <stdarg.h>

#include "history.c"

#define REFUSED(status) ((status) > FMI(Warning))
#define ACTS (SHAPES || PORTS || DELAY >= 0) /* the terms change inputs */
#define DELAY_TIME(c) ((c)->p[DELAY < 0 ? 0 : DELAY])
#define SHORT 1e-6                           /* an instant, as part of a substep */
#define MOST_SUBSTEPS 1e6

typedef FMI(Status) Status;
typedef FMI(ValueReference) Reference;
typedef enum { INSTANTIATED, INITIALIZATION, RUNNING } Phase;

/* All that changes, without pointers: a snapshot is a copy. In model exchange the memory is that of the time `since`, and
 * inputs run straight from `before` to their values now. */
typedef struct {
    int phase, in_event, awake, stale, is_sent, is_held, knows_states; /* is_held: inputs of the host that were not sent on */
    double time, since, length, coming; /* coming: time of a jump of the inputs that is announced as an event, with the delay */
    double u[NU + 1], before[NU + 1], shaped[NU + 1], sent[NU + 1];
    double x[NX + 1], m[NM + 1], p[NP], own[OWNS + 1];
    int valid, has_sample, is_accepted; /* of the output `valid`, with the time and the signals at the start of a sample */
    double sample_time, sample[SIGNALS + 1];
} Course;

struct Wrapper {
    Functions f;
    void *library;
    FMI(Component) component, second; /* second: with other dampings, for directions of forces */
    Host host;
    int exchange;
    Course course;
    History history;
    Reference *references; /* room for values that are sent on */
    double *values;
    size_t room;
    Judged judged;
};

static Status worse(Status a, Status b)
{
    return a > b ? a : b;
}

static Status refuse(Wrapper *w, const char *format, ...)
{
    char message[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    say(&w->host, message);
    return FMI(Error);
}

/* Whether the second instance is kept in step; with dormant terms only until it is known that they are. */
#define NEEDS_SECOND(c) (DIRECTIONS && ((c)->phase != RUNNING || (c)->awake))
#define HAS_SECOND(w) (DIRECTIONS && (w)->second != NULL && NEEDS_SECOND(&(w)->course))
/* A call to both instances; what it returns is that of the first. */
#define BOTH(w, name, ...) \
    (HAS_SECOND(w) && REFUSED((w)->f.name((w)->second, ##__VA_ARGS__)) ? FMI(Error) : (w)->f.name((w)->component, ##__VA_ARGS__))

#define KNOWN(instance) \
    Wrapper *w = instance; \
    if (w == NULL) return FMI(Error)
#define HAS(name) \
    if (w->f.name == NULL) return refuse(w, "the original has no function %s", #name)
#define FORWARD(name, ...) \
    KNOWN(a0); \
    HAS(name); \
    return BOTH(w, name, ##__VA_ARGS__)
#define FORWARD_SETTLED(name, arguments) \
    KNOWN(a0); \
    HAS(name); \
    const Status settled = settle(w); \
    return REFUSED(settled) ? settled : worse(settled, w->f.name arguments)

/* -- terms --------------------------------------------------------------------------------------------------------- */

static void wake(Course *c)
{
    c->awake = 0;
    for (int k = 0; k < PARAMETERS; k++)
        if (!isnan(PARAMETER_NEUTRAL[k]) && c->p[k] != PARAMETER_NEUTRAL[k]) c->awake = 1;
    c->stale = 1;
}

/* The inputs of a substep from t on, and the memory (m: NM) after it; out: NU + NM. */
static void shape(Course *c, double t, double h, const double *u, const double *m, double *out)
{
    c->p[NP - 1] = h;
#if SHAPES
    shape_all(t, u, m, c->p, out);
#else
    (void)t;
    memcpy(out, u, sizeof(double) * NU);
    memcpy(out + NU, m, sizeof(double) * NM);
#endif
}

static long count_substeps(double span)
{
    const double count = SUBSTEP > 0.0 ? ceil(span / SUBSTEP - 1e-6) : 1.0;
    return count >= 1.0 ? (long)(count < MOST_SUBSTEPS ? count : MOST_SUBSTEPS) : 1;
}

static int is_delayed(const Course *c)
{
    return DELAY >= 0 && DELAY_TIME(c) > 0.0;
}

/* Before the past is asked for: what has changed since the last step is in it. */
static Status note_past(Wrapper *w)
{
    Course *c = &w->course;
    if (!is_delayed(c)) return FMI(OK);
    const double *u = w->exchange ? c->before : c->u;
    return jump(&w->history, c->since, u) ? refuse(w, "not enough memory for the input history") : FMI(OK);
}

/* Inputs over a part of a step, before they are shaped. With a straight course in model exchange their mean, otherwise those
 * that are held. share: the middle of the part between `since` and now. */
static void input_over(Wrapper *w, double t, double h, double share, double *u)
{
    Course *c = &w->course;
    if (is_delayed(c)) mean_of(&w->history, t - DELAY_TIME(c), t + h - DELAY_TIME(c), u);
    else for (int j = 0; j < NU; j++) u[j] = w->exchange ? c->before[j] + share * (c->u[j] - c->before[j]) : c->u[j];
}

/* The memory at a time from that at `since`; in model exchange, where time is not divided into steps. */
static void remember(Wrapper *w, double until, double *m)
{
    Course *c = &w->course;
    const double span = until - c->since;
    if (NM == 0 || !(span > 0.0)) return;
    const long n = count_substeps(span);
    double u[NU + 1], out[NU + NM + 1];
    for (long k = 0; k < n; k++) {
        const double h = span / (double)n, t = c->since + (double)k * h;
        input_over(w, t, h, ((double)k + 0.5) / (double)n, u);
        shape(c, t, h, u, m, out);
        memcpy(m, out + NU, sizeof(double) * NM);
    }
}

/* The inputs that act now, and the memory of now; nothing is remembered. A delay sees the course up to now. */
static Status shape_now(Wrapper *w, double *out)
{
    Course *c = &w->course;
    double m[NM + 1], u[NU + 1];
    const int is_past = is_delayed(c);
    const Status status = note_past(w);
    if (REFUSED(status)) return status;
    const int has_now = is_past && w->exchange && c->time > c->since && !append(&w->history, c->time, c->u);
    memcpy(m, c->m, sizeof m);
    remember(w, c->time, m);
    if (is_past) value_at(&w->history, EARLIER(c->time) - DELAY_TIME(c), c->coming, u);
    else memcpy(u, c->u, sizeof u);
    w->history.count -= has_now;
    shape(c, c->time, SHORT * c->length, u, m, out);
    return status;
}

/* The memory and the inputs of now as the last ones that are settled. */
static Status commit(Wrapper *w)
{
    Course *c = &w->course;
    Status status = FMI(OK);
    if (c->awake) {
        status = note_past(w);
        if (is_delayed(c) && c->time > c->since && append(&w->history, c->time, c->u))
            status = refuse(w, "not enough memory for the input history");
        remember(w, c->time, c->m);
        if (is_delayed(c)) forget(&w->history, c->time - DELAY_TIME(c));
    }
    c->since = c->time;
    c->is_accepted = 1;
    memcpy(c->before, c->u, sizeof c->u);
    return status;
}

#if PORTS || RATES
static Status find_states(Wrapper *w)
{
    Course *c = &w->course;
    if (NX == 0) return FMI(OK);
    if (!w->exchange) return GET(w, STATE_REFERENCE, NX, c->x);
    if (c->knows_states && c->phase == RUNNING) return FMI(OK);
    c->knows_states = 1;
    return w->f.GetContinuousStates(w->component, c->x, NX);
}
#endif

/* What the original gets: shaped inputs and forces at ports. */
static Status add_forces(Wrapper *w, const double *shaped, double *out)
{
    Course *c = &w->course;
#if PORTS
    const Status status = find_states(w);
    if (!REFUSED(status)) port_inputs(c->time, c->x, shaped, c->p, out);
    return status;
#else
    (void)c;
    memcpy(out, shaped, sizeof(double) * NU);
    return FMI(OK);
#endif
}

static Status send_inputs(Wrapper *w, const double *u)
{
    Course *c = &w->course;
    if (NU == 0 || (c->is_sent && memcmp(c->sent, u, sizeof(double) * NU) == 0)) return FMI(OK);
    memcpy(c->sent, u, sizeof(double) * NU);
    c->is_sent = 1;
    return SET(w, INPUT_REFERENCE, NU, u);
}

/* The inputs that act now, sent to the original; nothing is remembered. */
static Status settle(Wrapper *w)
{
    Course *c = &w->course;
    Status status = FMI(OK);
    if (!c->stale || c->phase == INSTANTIATED) return status;
    if (!c->awake) {
        const int is_behind = c->is_sent || c->is_held;
        c->is_sent = c->is_held = 0;
        if (is_behind) status = send_inputs(w, c->u);
        c->is_sent = 0; /* from now on the host's calls go to the original as they are */
    } else {
        double out[NU + NM + 1], u[NU + 1];
        status = shape_now(w, out);
        if (REFUSED(status)) return status;
        memcpy(c->shaped, out, sizeof(double) * NU);
        if (ACTS) {
            status = add_forces(w, out, u);
            if (!REFUSED(status)) status = worse(status, send_inputs(w, u));
        }
    }
    if (!REFUSED(status)) c->stale = 0;
    return status;
}

/* -- life ---------------------------------------------------------------------------------------------------------- */

static void begin(Wrapper *w)
{
    Course *c = &w->course;
    forget_all(&w->history);
    memset(c, 0, sizeof *c);
    c->length = SUBSTEP > 0.0 ? SUBSTEP : 1e-3;
    c->coming = HUGE_VAL;
    c->valid = HAS_REGION;
    memcpy(c->u, INPUT_START, sizeof(double) * NU);
    memcpy(c->before, INPUT_START, sizeof(double) * NU);
    memcpy(c->p, PARAMETER_START, sizeof(double) * PARAMETERS);
    memcpy(c->own, OWN_START, sizeof(double) * OWNS);
    wake(c);
}

#if DIRECTIONS
static double changed_damping(const Wrapper *w, int k)
{
    const double damping = w->course.own[DAMPING_OWN[k]], more = damping + DAMPING_CHANGE[k];
    return more <= DAMPING_HIGH[k] ? more : damping - DAMPING_CHANGE[k];
}
#endif

/* The dampings of the second instance, after those of the first. */
static Status change_dampings(Wrapper *w)
{
#if DIRECTIONS
    double damping[DIRECTIONS];
    if (w->second == NULL || w->course.phase == RUNNING) return FMI(OK);
    for (int k = 0; k < DIRECTIONS; k++) damping[k] = changed_damping(w, k);
    return SET_IN(w, w->second, DAMPING_REFERENCE, DIRECTIONS, damping);
#else
    (void)w;
    return FMI(OK);
#endif
}

/* Values of the original that its library does not have by itself. */
static Status set_own(Wrapper *w)
{
    const Status status = OWNS ? SET(w, OWN_REFERENCE, OWNS, w->course.own) : FMI(OK);
    return REFUSED(status) ? status : worse(status, change_dampings(w));
}

static void dispose(Wrapper *w)
{
    if (w->library != NULL) close_library(w->library);
    dispose_host(&w->host);
    free(w->history.rows);
    free(w->references);
    free(w->values);
    free(w);
}

/* A wrapper with the library of the original; NULL with the reason said. */
static Wrapper *created(Host host, int exchange, const char *resources)
{
    char reason[LONGEST_PATH] = "";
    Wrapper *w = calloc(1, sizeof *w);
    if (w == NULL) return NULL;
    w->host = host;
    w->exchange = exchange;
    begin(w);
    w->library = open_library(resources, reason, sizeof reason);
    if (w->library == NULL) {
        refuse(w, "the original does not load: %s", reason);
        dispose(w);
        return NULL;
    }
    find_functions(w->library, &w->f);
    return w;
}

static void free_instances(Wrapper *w)
{
    if (w->second != NULL) w->f.FreeInstance(w->second);
    if (w->component != NULL) w->f.FreeInstance(w->component);
}

/* The wrapper if the original is instantiated and takes its own values; otherwise NULL. */
static Wrapper *checked(Wrapper *w)
{
    const int has_all = w->component != NULL && (w->second != NULL || !(DIRECTIONS && w->exchange));
    if (has_all && !REFUSED(set_own(w))) return w;
    if (has_all) refuse(w, "the original rejects its own start values");
    else if (w->component != NULL) refuse(w, "the original allows no second instance, which forces need");
    free_instances(w);
    dispose(w);
    return NULL;
}

static const char *token_of_original(const char *token)
{
    return token != NULL && strcmp(token, OWN_TOKEN) == 0 ? ORIGINAL_TOKEN : token;
}

/* Own values again, because some originals forget those set before initialization. */
static Status after_entering_initialization(Wrapper *w, Status status)
{
    if (REFUSED(status)) return status;
    w->course.phase = INITIALIZATION;
    w->course.stale = 1;
    return worse(status, set_own(w));
}

void FMI(FreeInstance)(FMI(Component) a0)
{
    Wrapper *w = a0;
    if (w == NULL) return;
    free_instances(w);
    dispose(w);
}

Status FMI(ExitInitializationMode)(FMI(Component) a0)
{
    KNOWN(a0);
    HAS(ExitInitializationMode);
    Course *c = &w->course;
    Status status = settle(w);
    if (REFUSED(status)) return status;
    status = worse(status, BOTH(w, ExitInitializationMode));
    if (REFUSED(status)) return status;
    c->phase = RUNNING;
    c->in_event = w->exchange;
    c->since = c->time;
    c->is_accepted = 1;
    c->coming = HUGE_VAL;
    c->knows_states = 0;
    if (c->awake) c->stale = 1;
    memcpy(c->before, c->u, sizeof c->u);
    forget_all(&w->history);
    return worse(status, note_past(w));
}

Status FMI(Reset)(FMI(Component) a0)
{
    KNOWN(a0);
    HAS(Reset);
    w->course.phase = INSTANTIATED; /* so that both are reset */
    const Status status = BOTH(w, Reset);
    if (REFUSED(status)) return status;
    begin(w);
    return worse(status, set_own(w));
}

/* -- values -------------------------------------------------------------------------------------------------------- */

#define IS_PARAMETER(reference) ((Reference)((reference) - FIRST_PARAMETER) < PARAMETERS)

static const Special ORDINARY = {0, -1, -1, -1, -1, 1};

static const Special *special_of(Reference reference)
{
    int low = 0, high = SPECIALS;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (SPECIAL[middle].reference < reference) low = middle + 1;
        else high = middle;
    }
    return low < SPECIALS && SPECIAL[low].reference == reference ? &SPECIAL[low] : &ORDINARY;
}

static int names_parameters(const Reference vr[], size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (IS_PARAMETER(vr[k])) return 1;
    return 0;
}

static int reserve(Wrapper *w, size_t count)
{
    if (count <= w->room) return 0;
    free(w->references), free(w->values);
    w->references = malloc(sizeof *w->references * count);
    w->values = malloc(sizeof *w->values * count);
    w->room = w->references == NULL || w->values == NULL ? 0 : count;
    return w->room == 0;
}

#if READS
/* Outputs as delivered. */
static Status read_outputs(Wrapper *w, double *out)
{
    Course *c = &w->course;
    double y[NY + 1];
    const Status status = GET(w, OUTPUT_REFERENCE, NY, y);
    c->p[NP - 1] = c->length;
    if (!REFUSED(status)) readings(c->time, y, c->p, out);
    return status;
}
#endif

#if DIRECTIONS
/* Rates per force, behind the states in x, from both instances with the velocity at a usual speed and those of the other
 * directions at 0. Outside continuous-time mode states may not be set: with the velocities as they are, or NAN at rest. */
static Status find_directions(Wrapper *w, double *x)
{
    const Course *c = &w->course;
    const int may_move = c->phase == RUNNING && !c->in_event;
    double moved[NX], rates[2][NX];
    Status status = FMI(OK);
    memcpy(moved, x, sizeof moved);
    for (int k = 0; k < DIRECTIONS && !REFUSED(status); k++) {
        const double change = changed_damping(w, k) - c->own[DAMPING_OWN[k]];
        for (int j = 0; may_move && j < DIRECTIONS; j++) moved[BRAKED[j]] = j == k ? SPEED[k] : 0.0;
        if (may_move) status = BOTH(w, SetContinuousStates, moved, NX);
        if (!REFUSED(status)) status = worse(status, w->f.GetDerivatives(w->second, rates[1], NX));
        if (!REFUSED(status)) status = worse(status, w->f.GetDerivatives(w->component, rates[0], NX));
        const double v = moved[BRAKED[k]], is_told = may_move || (DIRECTIONS == 1 && fabs(v) > SHORT * SPEED[k]);
        for (int i = 0; i < NX; i++) x[NX * (k + 1) + i] = is_told ? (rates[1][i] - rates[0][i]) / (-change * v) : NAN;
    }
    return may_move ? worse(status, BOTH(w, SetContinuousStates, x, NX)) : status;
}
#endif

#if RATES
static Status find_added_rates(Wrapper *w, double *out)
{
    Course *c = &w->course;
    double x[NX * (1 + DIRECTIONS) + 1];
    Status status = find_states(w);
    memcpy(x, c->x, sizeof(double) * NX);
#if DIRECTIONS
    if (!REFUSED(status)) status = worse(status, find_directions(w, x));
#endif
    if (!REFUSED(status)) added_rates(c->time, x, c->shaped, c->p, out);
    return status;
}
#endif

/* Values of the original changed by the terms, from the first that is one; `values` are as the original has them. */
static Status change_values(Wrapper *w, const Reference vr[], size_t count, double value[])
{
    Course *c = &w->course;
    Status status = FMI(OK);
    int has_read = 0, has_rates = 0;
    double read[NY + 1], added[NX + 1];
    for (size_t k = 0, at = 0; k < count; k++) {
        const Special *s = special_of(vr[k]);
        if (IS_PARAMETER(vr[k])) value[at] = c->p[vr[k] - FIRST_PARAMETER];
        else if (!c->awake) {
        } else if (ACTS && s->input >= 0 && c->phase != INSTANTIATED) value[at] = c->u[s->input];
#if READS
        else if (s->output >= 0) {
            if (!has_read) status = worse(status, read_outputs(w, read));
            has_read = 1;
            value[at] = read[s->output];
        }
#endif
#if RATES
        else if (s->rate >= 0 && w->exchange && c->phase != INSTANTIATED) {
            if (!has_rates) status = worse(status, find_added_rates(w, added));
            has_rates = 1;
            value[at] += added[s->rate];
        }
#endif
        if (REFUSED(status)) return status;
        at += s->size;
    }
    (void)has_read, (void)has_rates, (void)read, (void)added;
    return status;
}

/* Values without those of the terms' parameters, which the original does not know. */
static Status get_apart(Wrapper *w, const Reference vr[], size_t count, double value[], size_t values)
{
    size_t kept = 0, at = 0, kept_values = 0;
    if (reserve(w, count + values)) return refuse(w, "not enough memory for values");
    for (size_t k = 0; k < count; k++) {
        if (IS_PARAMETER(vr[k])) continue;
        w->references[kept++] = vr[k];
        kept_values += special_of(vr[k])->size;
    }
    if (kept_values > values) return refuse(w, "%zu values for variables with %zu", values, kept_values);
    const Status status = kept ? GET_ALL(w, w->references, kept, w->values, kept_values) : FMI(OK);
    if (REFUSED(status)) return status;
    const double *from = w->values;
    for (size_t k = 0; k < count; k++) {
        const size_t size = special_of(vr[k])->size;
        if (!IS_PARAMETER(vr[k])) memcpy(value + at, from, sizeof(double) * size), from += size;
        at += size;
    }
    return status;
}

static Status get_reals(Wrapper *w, const Reference vr[], size_t count, double value[], size_t values)
{
    Course *c = &w->course;
    Status status = settle(w);
    if (REFUSED(status)) return status;
    const int apart = names_parameters(vr, count);
    if (apart) status = worse(status, get_apart(w, vr, count, value, values));
#if READS
    else if (c->awake && count == NY && memcmp(vr, OUTPUT_REFERENCE, sizeof *vr * count) == 0) {
        double y[NY + 1];
        status = worse(status, GET(w, vr, NY, y));
        c->p[NP - 1] = c->length;
        if (!REFUSED(status)) readings(c->time, y, c->p, value);
        return status;
    }
#endif
    else status = worse(status, GET_ALL(w, vr, count, value, values));
    if (REFUSED(status) || !(apart || c->awake)) return status;
    return worse(status, change_values(w, vr, count, value));
}

/* -- the output `valid` --------------------------------------------------------------------------------------------
 *
 * A sample begins at a communication point or an accepted step of the solver, and ends at the first one at least
 * LEAST_SAMPLE later. `valid` is that of the last complete sample. In model exchange, is_accepted holds from the end of a
 * step of the solver, or an event, until the solver tries other times or states. */

#define IS_ACCEPTED(w) ((w)->course.is_accepted || !(w)->exchange)

static int ends_sample(const Wrapper *w)
{
    const Course *c = &w->course;
    return c->has_sample && IS_ACCEPTED(w) && c->time - c->sample_time >= LEAST_SAMPLE;
}

/* The signals of now, if a sample ends, and the value of `valid`. */
static Status find_valid(Wrapper *w, double *now, int *valid)
{
    const Course *c = &w->course;
    *valid = c->valid;
    if (!ends_sample(w)) return FMI(OK);
    const Status status = get_reals(w, SIGNAL_REFERENCE, SIGNALS, now, SIGNALS);
    if (!REFUSED(status)) *valid = is_inside(c->sample, now, c->time - c->sample_time, &w->judged);
    return status;
}

/* Before time or states change at an accepted point: a sample that ends there is judged, and the next one begins. */
static Status note_sample(Wrapper *w)
{
    Course *c = &w->course;
    Status status = FMI(OK);
    double now[SIGNALS + 1];
    if (!HAS_REGION || c->phase != RUNNING || c->in_event) return status;
    const int is_end = ends_sample(w), is_first = IS_ACCEPTED(w) && (!c->has_sample || c->time <= c->sample_time);
    if (is_end) status = find_valid(w, now, &c->valid);
    else if (is_first) status = get_reals(w, SIGNAL_REFERENCE, SIGNALS, now, SIGNALS);
    if (REFUSED(status)) return status;
    if (is_end || is_first) {
        memcpy(c->sample, now, sizeof(double) * SIGNALS);
        c->sample_time = c->time;
        c->has_sample = 1;
    }
    c->is_accepted = 0;
    return status;
}

static Status get_booleans(Wrapper *w, const Reference vr[], size_t count, FMI(Boolean) value[], size_t values)
{
    Status status = settle(w);
    size_t at = 0, own = 0;
    for (size_t k = 0; HAS_VALID && k < count; k++) own += vr[k] == VALID_REFERENCE;
    if (REFUSED(status)) return status;
    if (own == 0) return worse(status, GET_BOOLEANS(w, vr, count, value, values));
    for (size_t k = 0; k < count && !REFUSED(status); k++) {
        const size_t size = special_of(vr[k])->size;
        double now[SIGNALS + 1];
        int valid;
        if (at + size > values) return refuse(w, "only %zu values for %zu variables", values, count);
        if (vr[k] == VALID_REFERENCE) status = worse(status, find_valid(w, now, &valid)), value[at] = valid;
        else status = worse(status, GET_BOOLEANS(w, vr + k, 1, value + at, size));
        at += size;
    }
    return status;
}

/* -- values of the host -------------------------------------------------------------------------------------------- */

/* Note a value that the host sets; 1: it is the original's too; 0: it is not; -1: it is refused. */
static int note(Wrapper *w, Reference reference, const Special *s, double value)
{
    Course *c = &w->course;
    if (IS_PARAMETER(reference)) {
        const int k = (int)(reference - FIRST_PARAMETER);
        if (c->phase == RUNNING) {
            refuse(w, "%s is a fixed parameter; set it before the end of initialization", PARAMETER_NAME[k]);
            return -1;
        }
        c->p[k] = value;
        wake(c);
        return 0;
    }
    if (s->own >= 0) c->own[s->own] = value;
    if (s->input < 0) return 1;
    if (w->exchange && c->in_event && c->time > c->since && REFUSED(commit(w))) return -1;
    c->u[s->input] = value;
    if (c->in_event) c->before[s->input] = value; /* a jump; between events a host may try older inputs, too */
    if (!c->awake || !ACTS || c->phase == INSTANTIATED) {
        c->is_sent = 0;
        return 1;
    }
    c->stale = c->is_held = 1;
    return 0;
}

static Status set_reals(Wrapper *w, const Reference vr[], size_t count, const double value[], size_t values)
{
    Course *c = &w->course;
    size_t kept = 0, at = 0, kept_values = 0;
    if (c->phase == RUNNING && !c->awake && !names_parameters(vr, count)) return SET_ALL(w, vr, count, value, values);
    if (reserve(w, count + values)) return refuse(w, "not enough memory for values");
    for (size_t k = 0; k < count; k++) {
        const Special *s = special_of(vr[k]);
        const size_t size = s->size;
        if (at + size > values) return refuse(w, "only %zu values for %zu variables", values, count);
        const int is_original = note(w, vr[k], s, value[at]);
        if (is_original < 0) return FMI(Error);
        if (is_original) {
            w->references[kept++] = vr[k];
            memcpy(w->values + kept_values, value + at, sizeof(double) * size);
            kept_values += size;
        }
        at += size;
    }
    if (c->phase == INITIALIZATION && c->awake) c->stale = 1; /* states may follow from what is set */
    const Status status = kept ? SET_ALL(w, w->references, kept, w->values, kept_values) : FMI(OK);
    return REFUSED(status) ? status : worse(status, change_dampings(w));
}

/* -- co-simulation ------------------------------------------------------------------------------------------------- */

static long substeps_of(const Wrapper *w, double h)
{
    return ANY_STEP && (PORTS || NM > 0 || DELAY >= 0) && may_divide(&w->host) ? count_substeps(h) : 1;
}

static Status take_steps(Wrapper *w, double t, double h, FMI(Boolean) no_state_before, Ending *end)
{
    Course *c = &w->course;
    Status status = note_sample(w);
    if (REFUSED(status)) return status;
    if (!c->awake || !ACTS) {
        status = worse(status, settle(w));
        if (REFUSED(status)) return status;
        c->time = c->since = t + h;
        return worse(status, one_step(w, t, h, no_state_before, end));
    }
    const long n = substeps_of(w, h);
    const double dt = h / (double)n;
    c->length = dt > 0.0 ? dt : c->length;
    c->time = c->since = t;
    if (REFUSED(note_past(w))) return FMI(Error);
    if (is_delayed(c)) forget(&w->history, t - DELAY_TIME(c));
    for (long k = 0; k < n && !end->stop; k++) {
        double out[NU + NM + 1], u[NU + 1];
        c->time = t + (double)k * dt;
        input_over(w, c->time, c->length, 0.0, u);
        shape(c, c->time, dt, u, c->m, out);
        memcpy(c->shaped, out, sizeof(double) * NU);
        status = worse(status, add_forces(w, out, u));
        if (!REFUSED(status)) status = worse(status, send_inputs(w, u));
        if (!REFUSED(status)) status = worse(status, one_step(w, c->time, dt, no_state_before, end));
        if (REFUSED(status)) return status;
        memcpy(c->m, out + NU, sizeof(double) * NM);
        c->time = k == n - 1 ? t + h : c->time + dt;
    }
    c->since = c->time;
    c->stale = 0;
    return status;
}

/* -- model exchange ------------------------------------------------------------------------------------------------ */

Status FMI(SetTime)(FMI(Component) a0, double time)
{
    KNOWN(a0);
    HAS(SetTime);
    const Status status = note_sample(w);
    if (REFUSED(status)) return status;
    w->course.time = time;
    w->course.stale = w->course.awake;
    return worse(status, BOTH(w, SetTime, time));
}

Status FMI(SetContinuousStates)(FMI(Component) a0, const double x[], size_t count)
{
    KNOWN(a0);
    HAS(SetContinuousStates);
    Course *c = &w->course;
    const Status status = note_sample(w);
    if (REFUSED(status)) return status;
    if (c->awake && count == NX) {
        memcpy(c->x, x, sizeof(double) * NX);
        c->knows_states = 1;
        if (PORTS) c->stale = 1;
    }
    return worse(status, BOTH(w, SetContinuousStates, x, count));
}

static Status get_derivatives(Wrapper *w, double dx[], size_t count)
{
    Status status = settle(w);
    if (REFUSED(status)) return status;
    status = worse(status, w->f.GetDerivatives(w->component, dx, count));
#if RATES
    double added[NX + 1];
    if (REFUSED(status) || !w->course.awake || count != NX) return status;
    status = worse(status, find_added_rates(w, added));
    for (int k = 0; k < NX; k++) dx[k] += added[k];
#endif
    return status;
}

Status FMI(EnterEventMode)(FMI(Component) a0)
{
    KNOWN(a0);
    HAS(EnterEventMode);
    const Status status = settle(w);
    if (REFUSED(status)) return status;
    if (w->exchange && REFUSED(commit(w))) return FMI(Error);
    w->course.in_event = w->exchange;
    return worse(status, BOTH(w, EnterEventMode));
}

Status FMI(EnterContinuousTimeMode)(FMI(Component) a0)
{
    KNOWN(a0);
    HAS(EnterContinuousTimeMode);
    const Status status = settle(w);
    if (REFUSED(status)) return status;
    w->course.in_event = 0;
    return worse(status, BOTH(w, EnterContinuousTimeMode));
}

Status FMI(CompletedIntegratorStep)(FMI(Component) a0, FMI(Boolean) no_state_before, FMI(Boolean) *event, FMI(Boolean) *terminate)
{
    KNOWN(a0);
    HAS(CompletedIntegratorStep);
    Status status = settle(w);
    if (REFUSED(status)) return status;
    if (REFUSED(commit(w))) return FMI(Error);
    status = worse(status, BOTH(w, CompletedIntegratorStep, no_state_before, event, terminate));
    double now[SIGNALS + 1];
    int valid;
    if (REFUSED(status)) return status;
    status = worse(status, find_valid(w, now, &valid));
    if (valid != w->course.valid) *event = FMI(True); /* a discrete variable changes in event mode */
    return status;
}

/* Before discrete states are updated: delayed inputs that are due have arrived. */
static Status before_update(Wrapper *w)
{
    Course *c = &w->course;
    if (EARLIER(c->time) - DELAY_TIME(c) >= c->coming) c->coming = HUGE_VAL;
    if (c->awake) c->stale = 1;
    return settle(w);
}

/* After discrete states are updated, which may change states. next: when a delayed input arrives; infinity without one. */
static Status after_update(Wrapper *w, Status status, double *next)
{
    Course *c = &w->course;
    c->knows_states = 0;
    if (c->awake) c->stale = 1;
    *next = HUGE_VAL;
    if (!c->awake || !w->exchange || !is_delayed(c)) return status;
    c->coming = next_jump(&w->history, EARLIER(c->time) - DELAY_TIME(c));
    *next = c->coming + DELAY_TIME(c);
    return status;
}

/* -- state --------------------------------------------------------------------------------------------------------- */

typedef struct {
    FMI(FMUstate) original, second;
    Course course;
    History history;
} Snapshot;

/* Of a serialized state, before those of the second instance and of the original: token, course, rows of the past, size of
 * the state of the second instance, and the rows. */
#define HEAD (sizeof OWN_TOKEN + sizeof(Course) + 2 * sizeof(double))
#define PAST(s) (sizeof(double) * ROW * (s)->history.count)

static Snapshot *snapshot_at(FMI(FMUstate) state)
{
    return state == NULL ? calloc(1, sizeof(Snapshot)) : state;
}

static void free_snapshot(Snapshot *s)
{
    free(s->history.rows);
    free(s);
}

/* 1 without memory for it. */
static int copy_history(const History *from, History *to)
{
    forget_all(to);
    for (size_t k = 0; k < from->count; k++)
        if (append(to, row_of(from, k)[0], row_of(from, k) + 1)) return 1;
    return 0;
}

Status FMI(GetFMUstate)(FMI(Component) a0, FMI(FMUstate) *state)
{
    KNOWN(a0);
    HAS(GetFMUstate);
    Snapshot *s = snapshot_at(*state);
    if (s == NULL) return refuse(w, "not enough memory for a state");
    Status status = w->f.GetFMUstate(w->component, &s->original);
    if (!REFUSED(status) && HAS_SECOND(w)) status = worse(status, w->f.GetFMUstate(w->second, &s->second));
    if (!REFUSED(status) && copy_history(&w->history, &s->history)) status = refuse(w, "not enough memory for a state");
    s->course = w->course;
    if (!REFUSED(status)) *state = s;
    else if (*state == NULL) free_snapshot(s);
    return status;
}

Status FMI(SetFMUstate)(FMI(Component) a0, FMI(FMUstate) state)
{
    KNOWN(a0);
    HAS(SetFMUstate);
    const Snapshot *s = state;
    if (s == NULL) return refuse(w, "there is no such state");
    Status status = w->f.SetFMUstate(w->component, s->original);
    if (!REFUSED(status) && HAS_SECOND(s)) status = worse(status, w->f.SetFMUstate(w->second, s->second));
    if (REFUSED(status)) return status;
    w->course = s->course;
    return copy_history(&s->history, &w->history) ? refuse(w, "not enough memory for a state") : status;
}

Status FMI(FreeFMUstate)(FMI(Component) a0, FMI(FMUstate) *state)
{
    KNOWN(a0);
    if (state == NULL || *state == NULL) return FMI(OK);
    HAS(FreeFMUstate);
    Snapshot *s = *state;
    Status status = FMI(OK);
    if (s->second != NULL) status = w->f.FreeFMUstate(w->second, &s->second);
    status = worse(status, w->f.FreeFMUstate(w->component, &s->original));
    free_snapshot(s);
    *state = NULL;
    return status;
}

/* Size of the state of the second instance, 0 without one. */
static Status size_of_second(Wrapper *w, const Snapshot *s, size_t *size)
{
    *size = 0;
    return HAS_SECOND(s) ? w->f.SerializedFMUstateSize(w->second, s->second, size) : FMI(OK);
}

Status FMI(SerializedFMUstateSize)(FMI(Component) a0, FMI(FMUstate) state, size_t *size)
{
    KNOWN(a0);
    HAS(SerializedFMUstateSize);
    const Snapshot *s = state;
    size_t second;
    if (s == NULL) return refuse(w, "there is no such state");
    Status status = size_of_second(w, s, &second);
    if (!REFUSED(status)) status = worse(status, w->f.SerializedFMUstateSize(w->component, s->original, size));
    *size += HEAD + PAST(s) + second;
    return status;
}

Status FMI(SerializeFMUstate)(FMI(Component) a0, FMI(FMUstate) state, FMI(Byte) bytes[], size_t size)
{
    KNOWN(a0);
    HAS(SerializeFMUstate);
    const Snapshot *s = state;
    size_t second = 0;
    Status status = s == NULL ? FMI(OK) : size_of_second(w, s, &second);
    if (s == NULL || size < HEAD + PAST(s) + second) return refuse(w, "the buffer is too small for the state");
    const double counts[] = {(double)s->history.count, (double)second};
    FMI(Byte) *at = bytes;
    memcpy(at, OWN_TOKEN, sizeof OWN_TOKEN), at += sizeof OWN_TOKEN;
    memcpy(at, &s->course, sizeof(Course)), at += sizeof(Course);
    memcpy(at, counts, sizeof counts), at += sizeof counts;
    if (s->history.count > 0) memcpy(at, row_of(&s->history, 0), PAST(s)), at += PAST(s);
    if (second > 0) status = worse(status, w->f.SerializeFMUstate(w->second, s->second, at, second)), at += second;
    if (REFUSED(status)) return status;
    return worse(status, w->f.SerializeFMUstate(w->component, s->original, at, size - HEAD - PAST(s) - second));
}

/* Course and past of a serialized state; 1 if it is of another FMU, damaged or too large. second: size of the state of the
 * second instance. */
static int read_head(Snapshot *s, const FMI(Byte) bytes[], size_t size, size_t *second)
{
    double rows, row[ROW], more;
    const FMI(Byte) *at = bytes + sizeof OWN_TOKEN;
    if (size < HEAD || memcmp(bytes, OWN_TOKEN, sizeof OWN_TOKEN) != 0) return 1;
    memcpy(&s->course, at, sizeof(Course)), at += sizeof(Course);
    memcpy(&rows, at, sizeof rows), at += sizeof rows;
    memcpy(&more, at, sizeof more), at += sizeof more;
    if (!(rows >= 0.0 && more >= 0.0 && rows * sizeof row + more <= (double)(size - HEAD))) return 1;
    *second = (size_t)more;
    forget_all(&s->history);
    for (size_t k = 0; k < (size_t)rows; k++, at += sizeof row) {
        memcpy(row, at, sizeof row);
        if (append(&s->history, row[0], row + 1)) return 1;
    }
    return 0;
}

Status FMI(DeSerializeFMUstate)(FMI(Component) a0, const FMI(Byte) bytes[], size_t size, FMI(FMUstate) *state)
{
    KNOWN(a0);
    HAS(DeSerializeFMUstate);
    Snapshot *s = snapshot_at(*state);
    if (s == NULL) return refuse(w, "not enough memory for a state");
    size_t second = 0;
    Status status = read_head(s, bytes, size, &second) ? refuse(w, "this state is damaged, or belongs to another FMU") : FMI(OK);
    if (!REFUSED(status)) {
        const size_t past = HEAD + PAST(s), head = past + second;
        if (second > 0) status = w->f.DeSerializeFMUstate(w->second, bytes + past, second, &s->second);
        if (!REFUSED(status)) status = w->f.DeSerializeFMUstate(w->component, bytes + head, size - head, &s->original);
    }
    if (!REFUSED(status)) *state = s;
    else if (*state == NULL) free_snapshot(s);
    return status;
}
