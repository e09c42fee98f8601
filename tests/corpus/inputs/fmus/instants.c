/* FMI 3.0 with event mode, clocks and scheduled execution; it refuses every call that the standard does not allow.
 * x rises by u. When it reaches `level`, an event: x falls to `floor`, `events` counts it, `at` is its time, the clock
 * `crossed` ticks. An announced event every `announced` s counts in `timely`. A changed `kick` is added to x in event
 * mode; `echo` follows it there (kick + plus, at most `most`). The clock `sample` (of any kind) reads `w` and sets
 * y = gain·w + ticks. `trigger` counts in `triggered` and starts the clock `alarm` after `delay`, which sets `rung`. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef uint32_t VR;
typedef void (*Update)(void *, double, bool, bool, bool, bool, bool *, double *);
typedef void (*Log)(void *, int, const char *, const char *);
enum { TIME, U, X, LEVEL, FLOOR, AT, W, Y, GAIN, DELAY, ANNOUNCED, OWN_STEP, RUNG, LATEST_W, REALS };
enum { KICK = 20, EVENTS, TIMELY, ECHO, PLUS, MOST, TICKS, TRIGGERED, RETURNS, ORDER, WHOLES_END };
enum { SAMPLE = 40, TRIGGER, CROSSED, ALARM };
enum { INSTANTIATED, INITIALIZATION, EVENT, STEP, ACTIVATION, FATAL };
typedef struct {
    double real[REALS];
    int whole[WHOLES_END - KICK];
    int mode, kicked, alarm_set, sample_changed;
    bool events_used, may_return, crossing, sample, trigger, crossed, alarm;
    double time, next, interval;
    Log log;
    void *environment;
    Update update;
    void (*clocks)(void *);
} M;
#define R(k) m->real[k]
#define N(k) m->whole[(k) - KICK]
static int fail(M *m, const char *text) { m->log(m->environment, 3, "logStatusError", text); return 3; }
#define NEED(condition, text) do { if (!(condition)) return fail(m, text); } while (0)

const char *fmi3GetVersion(void) { return "3.0"; }
static M *make(void *environment, Log log) {
    M *m = calloc(1, sizeof(M));
    R(LEVEL) = 1; R(GAIN) = 1; R(DELAY) = 0.1; m->interval = 0.1; N(MOST) = 1000000;
    m->log = log; m->environment = environment;
    return m;
}
C fmi3InstantiateCoSimulation(const char *name, const char *token, const char *place, bool visible, bool logging, bool events,
                              bool early, const VR *v, size_t n, void *environment, Log log, Update update) {
    M *m = make(environment, log);
    (void)name; (void)token; (void)place; (void)visible; (void)logging; (void)v; (void)n;
    m->events_used = events; m->may_return = early; m->update = update;
    return m;
}
C fmi3InstantiateScheduledExecution(const char *name, const char *token, const char *place, bool visible, bool logging,
                                    void *environment, Log log, void (*clocks)(void *), void (*lock)(void), void (*unlock)(void)) {
    M *m = make(environment, log);
    (void)name; (void)token; (void)place; (void)visible; (void)logging; (void)lock; (void)unlock;
    m->clocks = clocks;
    return m;
}
void fmi3FreeInstance(C c) { free(c); }
int fmi3SetDebugLogging(C c, bool on, size_t n, const char *const *names) { (void)c; (void)on; (void)n; (void)names; return 0; }
int fmi3Terminate(C c) { (void)c; return 0; }
int fmi3Reset(C c) { (void)c; return 0; }
int fmi3EnterInitializationMode(C c, bool defined, double tolerance, double start, bool stop, double end) {
    M *m = c;
    (void)defined; (void)tolerance; (void)stop; (void)end;
    NEED(m->mode == INSTANTIATED, "initialization mode is entered twice");
    m->mode = INITIALIZATION; m->time = start;
    return 0;
}
int fmi3ExitInitializationMode(C c) {
    M *m = c;
    m->next = R(ANNOUNCED) > 0 ? m->time + R(ANNOUNCED) : INFINITY;
    m->mode = m->clocks ? ACTIVATION : m->events_used ? EVENT : STEP;
    return 0;
}
int fmi3EnterEventMode(C c) {
    M *m = c;
    NEED(m->events_used && m->mode == STEP, "event mode is entered from another mode than step mode");
    m->mode = EVENT; m->crossed = m->crossing;
    return 0;
}
int fmi3EnterStepMode(C c) {
    M *m = c;
    NEED(m->mode == EVENT, "step mode is entered from another mode than event mode");
    NEED(!m->sample && !m->trigger && !m->alarm && !m->kicked, "event mode is left before its discrete states are updated");
    m->mode = STEP;
    return 0;
}
static void read_sample(M *m) {
    N(TICKS)++;
    R(LATEST_W) = R(W);
    R(Y) = R(GAIN) * R(W) + N(TICKS);
    R(AT) = m->time;
    N(ORDER) = N(ORDER) % 1000000 * 10 + 1;
    m->sample_changed = 2;
    m->interval *= 2; /* of a changing clock */
}
static void take_trigger(M *m) { N(TRIGGERED)++; m->alarm_set = 2; N(ORDER) = N(ORDER) % 1000000 * 10 + 2; }
static void ring(M *m) { R(RUNG) = m->time; N(ORDER) = N(ORDER) % 1000000 * 10 + 3; }
static void count_crossing(M *m) { R(X) = R(FLOOR); N(EVENTS)++; R(AT) = m->time; m->crossing = false; }
int fmi3UpdateDiscreteStates(C c, bool *more, bool *end, bool *nominals, bool *states, bool *defined, double *next) {
    M *m = c;
    NEED(m->mode == EVENT, "discrete states are updated outside of event mode");
    *more = *end = *nominals = *states = false;
    if (m->crossing) count_crossing(m);
    if (m->time >= m->next - 1e-12) { N(TIMELY)++; m->next += R(ANNOUNCED); }
    if (m->kicked) { R(X) += N(KICK); R(AT) = m->time; m->kicked = 0; }
    if (m->trigger) take_trigger(m);
    if (m->alarm) ring(m);
    m->sample = m->trigger = m->crossed = m->alarm = false;
    *defined = isfinite(m->next);
    *next = m->next;
    return 0;
}
static bool needs(VR v, M *m, bool *access) { /* clocked variables, and whether their clock ticks */
    if (v == W || v == Y || v == LATEST_W) *access = m->sample || m->mode == INITIALIZATION || m->mode == INSTANTIATED || m->mode == ACTIVATION;
    return *access;
}
int fmi3GetFloat64(C c, const VR *v, size_t n, double *x, size_t k) {
    M *m = c;
    (void)k;
    R(TIME) = m->time;
    for (size_t i = 0; i < n; i++) {
        bool access = true;
        NEED(needs(v[i], m, &access), "a clocked variable is read while its clock does not tick");
        x[i] = R(v[i]);
    }
    return 0;
}
int fmi3SetFloat64(C c, const VR *v, size_t n, const double *x, size_t k) {
    M *m = c;
    (void)k;
    for (size_t i = 0; i < n; i++) {
        bool access = true;
        NEED(needs(v[i], m, &access), "a clocked variable is set while its clock does not tick");
        R(v[i]) = x[i];
    }
    if (m->sample && m->mode == EVENT) R(Y) = R(GAIN) * R(W) + N(TICKS);
    return 0;
}
int fmi3GetInt32(C c, const VR *v, size_t n, int *x, size_t k) { M *m = c; (void)k; while (n--) x[n] = N(v[n]); return 0; }
int fmi3SetInt32(C c, const VR *v, size_t n, const int *x, size_t k) {
    M *m = c;
    (void)k;
    for (size_t i = 0; i < n; i++) {
        NEED(m->mode != STEP || !m->events_used || v[i] != KICK, "a discrete input is set outside of event mode");
        if (v[i] == KICK && N(KICK) != x[i] && m->mode == EVENT) m->kicked = 1;
        N(v[i]) = x[i];
        if (v[i] == KICK) N(ECHO) = fmin(x[i] + N(PLUS), N(MOST));
    }
    return 0;
}
int fmi3SetClock(C c, const VR *v, size_t n, const bool *x) {
    M *m = c;
    NEED(m->mode == EVENT, "a clock is set outside of event mode");
    for (size_t i = 0; i < n; i++) {
        NEED(v[i] == SAMPLE || v[i] == TRIGGER || v[i] == ALARM, "an output clock is set");
        if (v[i] == SAMPLE && x[i] && !m->sample) { m->sample = true; read_sample(m); }
        if (v[i] == TRIGGER) m->trigger = x[i];
        if (v[i] == ALARM) m->alarm = x[i];
    }
    return 0;
}
int fmi3GetClock(C c, const VR *v, size_t n, bool *x) {
    M *m = c;
    NEED(m->mode == EVENT || m->mode == ACTIVATION, "a clock is read outside of event mode");
    while (n--) x[n] = v[n] == CROSSED && m->crossed;
    if (m->mode == ACTIVATION) m->crossed = false;
    return 0;
}
int fmi3GetIntervalDecimal(C c, const VR *v, size_t n, double *x, int *qualifier) {
    M *m = c;
    NEED(m->mode != STEP, "an interval is read in step mode");
    for (size_t i = 0; i < n; i++) {
        int *changed = v[i] == ALARM ? &m->alarm_set : &m->sample_changed;
        if (v[i] == SAMPLE && m->mode == INITIALIZATION) *changed = 2;
        x[i] = v[i] == ALARM ? R(DELAY) : m->interval;
        qualifier[i] = *changed;
        if (*changed == 2) *changed = 1;
    }
    return 0;
}
int fmi3GetShiftDecimal(C c, const VR *v, size_t n, double *x) { (void)c; (void)v; while (n--) x[n] = 0.05; return 0; }
int fmi3SetIntervalDecimal(C c, const VR *v, size_t n, const double *x) { M *m = c; (void)v; while (n--) R(RUNG) = x[n]; return 0; }
/* Steps: to the end, or to the first event; each own step is announced to the importer, who may end the step there. */
int fmi3DoStep(C c, double t, double h, bool no, bool *event, bool *end, bool *early, double *last) {
    M *m = c;
    const double to = t + h, own = R(OWN_STEP) > 0 ? R(OWN_STEP) : h;
    bool asked = false;
    (void)no;
    NEED(m->mode == STEP, "a step is made outside of step mode");
    NEED(fabs(t - m->time) < 1e-9, "a step does not begin where the last one ended");
    NEED(h > 0, "a step has no length");
    *event = *end = *early = false;
    while (!*event && !asked && to - m->time > 1e-13) {
        double next = fmin(to, m->time + own), at = INFINITY;
        const double u = R(U);
        if (to - next < 1e-9 * h) next = to;
        if (u > 0 && R(X) < R(LEVEL)) at = m->time + (R(LEVEL) - R(X)) / u;
        if (at <= next && m->events_used && m->may_return) { m->crossing = *event = true; next = at; R(X) = R(LEVEL); }
        else R(X) += u * (next - m->time);
        m->time = next;
        if (m->events_used && !m->may_return && R(X) >= R(LEVEL)) m->crossing = true;
        if (!m->events_used && R(X) >= R(LEVEL)) count_crossing(m);
        if (m->update && R(OWN_STEP) > 0) {
            double when = next;
            m->update(m->environment, next, false, true, true, m->may_return && next < to, &asked, &when);
        }
    }
    if (m->crossing) *event = m->events_used;
    *early = m->may_return && to - m->time > 1e-13;
    if (*early) N(RETURNS)++;
    *last = m->time;
    return 0;
}
int fmi3ActivateModelPartition(C c, VR v, double t) {
    M *m = c;
    NEED(m->mode == ACTIVATION, "a partition is activated in another mode");
    NEED(t >= m->time, "time goes back");
    R(X) += R(U) * (t - m->time);
    m->time = t;
    if (v == SAMPLE) read_sample(m);
    if (v == TRIGGER) take_trigger(m);
    if (v == ALARM) ring(m);
    if (R(X) >= R(LEVEL)) { count_crossing(m); m->crossed = true; }
    if (m->crossed || m->alarm_set == 2) m->clocks(m->environment);
    return 0;
}
int fmi3GetFMUState(C c, void **state) { if (!*state) *state = malloc(sizeof(M)); memcpy(*state, c, sizeof(M)); return 0; }
int fmi3SetFMUState(C c, void *state) { memcpy(c, state, sizeof(M)); return 0; }
int fmi3FreeFMUState(C c, void **state) { (void)c; free(*state); *state = NULL; return 0; }
#define NONE(name) int name(void) { return 3; }
NONE(fmi3InstantiateModelExchange) NONE(fmi3GetFloat32) NONE(fmi3SetFloat32) NONE(fmi3GetInt8) NONE(fmi3SetInt8)
NONE(fmi3GetInt16) NONE(fmi3SetInt16) NONE(fmi3GetInt64) NONE(fmi3SetInt64) NONE(fmi3GetUInt8) NONE(fmi3SetUInt8)
NONE(fmi3GetUInt16) NONE(fmi3SetUInt16) NONE(fmi3GetUInt32) NONE(fmi3SetUInt32) NONE(fmi3GetUInt64) NONE(fmi3SetUInt64)
NONE(fmi3GetBoolean) NONE(fmi3SetBoolean) NONE(fmi3GetString) NONE(fmi3SetString) NONE(fmi3GetBinary) NONE(fmi3SetBinary)
NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetVariableDependencies) NONE(fmi3SerializedFMUStateSize)
NONE(fmi3SerializeFMUState) NONE(fmi3DeserializeFMUState) NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetAdjointDerivative) NONE(fmi3EnterConfigurationMode) NONE(fmi3ExitConfigurationMode)
NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftFraction) NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction) NONE(fmi3EvaluateDiscreteStates) NONE(fmi3GetOutputDerivatives)
NONE(fmi3EnterContinuousTimeMode) NONE(fmi3CompletedIntegratorStep) NONE(fmi3SetTime) NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives) NONE(fmi3GetEventIndicators) NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates) NONE(fmi3GetNumberOfEventIndicators) NONE(fmi3GetNumberOfContinuousStates)
