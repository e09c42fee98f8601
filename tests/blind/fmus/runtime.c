/* FMI 2.0 (-DFMI=2) or 3.0 (-DFMI=3) around a plant, for model exchange and co-simulation. The plant is the file PLANT;
 * numbers and start values come from layout.h. Value references: inputs 0…, states 100…, derivatives 200…, further
 * outputs 300…, parameters 400…, time 999. Misbehaviour is compiled in with the macros of fmu_build.FAULTS. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#if FMI == 2
#include "fmi2Functions.h"
typedef fmi2Status Status;
typedef fmi2ValueReference VR;
enum { OK = fmi2OK, BAD = fmi2Error };
#else
#include "fmi3Functions.h"
typedef fmi3Status Status;
typedef fmi3ValueReference VR;
enum { OK = fmi3OK, BAD = fmi3Error };
#endif
#include "layout.h" /* NU, NX, NY, NP, INNER, INPUTS, STATES, PARAMETERS */

static void rates(const double *p, double t, const double *x, const double *u, double *dx);
static void readings(const double *p, double t, const double *x, const double *u, double *y);
#include PLANT

enum { INPUT = 0, STATE = 100, RATE = 200, READING = 300, PARAMETER = 400, TIME = 999 };
enum { INSTANTIATED, INITIALIZING, RUNNING };
typedef struct { double t, u[NU + 1], x[NX], p[NP + 1], scale; int phase; } M;

static void fresh(M *m) {
    const double u[] = INPUTS, x[] = STATES, p[] = PARAMETERS;
    memset(m, 0, sizeof *m);
    memcpy(m->u, u, sizeof(double) * NU);
    memcpy(m->x, x, sizeof(double) * NX);
    memcpy(m->p, p, sizeof(double) * NP);
    m->scale = 1.0;
}
static M *make(void) {
    M *m = malloc(sizeof(M));
    fresh(m);
#ifdef LEAKS
    volatile char *lost = malloc(LEAKS); /* volatile: or the compiler leaves it out */
    for (size_t i = 0; lost && i < LEAKS; i += 512) lost[i] = 1;
#endif
#ifdef FOLDER /* a number that depends on the working directory */
    char here[4096];
    unsigned sum = 0;
    for (const char *c = getcwd(here, sizeof here) ? here : ""; *c; c++) sum = 31 * sum + (unsigned char)*c;
    m->scale += FOLDER * (1.0 + sum) / 4294967296.0; /* hardly ever alike for two folders */
#endif
    return m;
}
static int reset(M *m) {
#ifndef IDLE_RESET
    fresh(m);
#else
    m->phase = INSTANTIATED;
#endif
    return OK;
}
static int enter(M *m, double t) {
    m->t = t;
    m->phase = INITIALIZING;
#ifdef FORGETS
    const double p[] = PARAMETERS;
    memcpy(m->p, p, sizeof(double) * NP);
#endif
    return OK;
}
static void derive(M *m, double t, const double *x, double *dx) {
#ifdef CRASHES
    if (m->p[0] > CRASHES) abort();
#endif
#ifdef HANGS
    while (m->p[0] > HANGS) usleep(1000);
#endif
    rates(m->p, t, x, m->u, dx);
#ifdef COUNTS /* never twice the same */
    static long count;
#ifdef CLOCK
    struct timespec now;
    if (!count && !clock_gettime(CLOCK_REALTIME, &now)) count = now.tv_nsec / 1000;
#endif
    dx[NX - 1] *= 1.0 + COUNTS * sin((double)count++);
#endif
    for (int i = 0; m->scale != 1.0 && i < NX; i++) dx[i] *= m->scale;
}
static void runge_kutta(M *m, double h) {
    double k[4][NX], x[NX];
    const double part[] = {0.0, 0.5, 0.5, 1.0};
    for (int s = 0; s < 4; s++) {
        for (int i = 0; i < NX; i++) x[i] = m->x[i] + (s ? part[s] * h * k[s - 1][i] : 0.0);
        derive(m, m->t + part[s] * h, x, k[s]);
    }
    for (int i = 0; i < NX; i++) m->x[i] += h / 6.0 * (k[0][i] + 2.0 * (k[1][i] + k[2][i]) + k[3][i]);
    m->t += h;
}
static int step(M *m, double t, double h) {
    m->t = t;
#ifdef OWN_STEP /* whole steps of its own only, one at least */
    const double begin = OWN_STEP, count = fmax(1.0, floor(h / OWN_STEP + 0.5));
    for (int i = 0; i < (int)count; i++)
        for (int j = 0; j < 10; j++) runge_kutta(m, begin / 10.0);
#else
    const int count = (int)ceil(h / INNER - 1e-9);
    for (int i = 0; i < count; i++) runge_kutta(m, h / count);
#endif
    m->t = t + h;
    for (int i = 0; i < NX; i++)
        if (!isfinite(m->x[i])) return BAD;
    return OK;
}
static int get(M *m, const VR *v, size_t n, double *value) {
    double dx[NX], y[NY + 1];
    derive(m, m->t, m->x, dx);
    readings(m->p, m->t, m->x, m->u, y);
    for (size_t i = 0; i < n; i++) {
        if (v[i] < NU) value[i] = m->u[v[i]];
        else if (v[i] >= STATE && v[i] < STATE + NX) value[i] = m->x[v[i] - STATE];
        else if (v[i] >= RATE && v[i] < RATE + NX) value[i] = dx[v[i] - RATE];
        else if (v[i] >= READING && v[i] < READING + NY) value[i] = y[v[i] - READING];
        else if (v[i] >= PARAMETER && v[i] < PARAMETER + NP) value[i] = m->p[v[i] - PARAMETER];
        else if (v[i] == TIME) value[i] = m->t;
        else return BAD;
    }
    return OK;
}
static int set(M *m, const VR *v, size_t n, const double *value) {
    for (size_t i = 0; i < n; i++) {
        if (v[i] < NU) m->u[v[i]] = value[i];
        else if (m->phase == RUNNING) return BAD;
        else if (v[i] >= STATE && v[i] < STATE + NX) m->x[v[i] - STATE] = value[i];
        else if (v[i] >= PARAMETER && v[i] < PARAMETER + NP) m->p[v[i] - PARAMETER] = value[i];
        else return BAD;
    }
    return OK;
}
static int save(M *m, void **kept) {
    if (!*kept) *kept = malloc(sizeof(M));
    memcpy(*kept, m, sizeof(M));
    return OK;
}
static void states(M *m, const double *x) { memcpy(m->x, x, sizeof m->x); }
#ifdef EVENTS
enum { EVENT = 1 };
#else
enum { EVENT = 0 };
#endif
#ifdef TICKS
enum { TICK = 1 };
#else
enum { TICK = 0 };
#define TICKS 1.0
#endif
static double next_tick(const M *m) { return (floor(m->t / TICKS + 1e-6) + 1.0) * TICKS; }

#if FMI == 2
typedef fmi2Component C;
const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return "2.0"; }
C fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String place, const fmi2CallbackFunctions *calls,
                  fmi2Boolean visible, fmi2Boolean logs) { return make(); }
void fmi2FreeInstance(C c) { free(c); }
Status fmi2SetDebugLogging(C c, fmi2Boolean on, size_t n, const fmi2String *names) { return fmi2OK; }
Status fmi2SetupExperiment(C c, fmi2Boolean has, fmi2Real tolerance, fmi2Real t, fmi2Boolean ends, fmi2Real end) {
    ((M *)c)->t = t;
    return fmi2OK;
}
Status fmi2EnterInitializationMode(C c) { return enter(c, ((M *)c)->t); }
Status fmi2ExitInitializationMode(C c) { ((M *)c)->phase = RUNNING; return fmi2OK; }
Status fmi2Terminate(C c) { return fmi2OK; }
Status fmi2Reset(C c) { return reset(c); }
Status fmi2GetReal(C c, const VR *v, size_t n, fmi2Real *x) { return get(c, v, n, x); }
Status fmi2SetReal(C c, const VR *v, size_t n, const fmi2Real *x) { return set(c, v, n, x); }
#define NONE(what, type) \
    Status fmi2Get##what(C c, const VR *v, size_t n, type *x) { return n ? fmi2Error : fmi2OK; } \
    Status fmi2Set##what(C c, const VR *v, size_t n, const type *x) { return n ? fmi2Error : fmi2OK; }
NONE(Integer, fmi2Integer) NONE(Boolean, fmi2Boolean) NONE(String, fmi2String)
Status fmi2GetFMUstate(C c, fmi2FMUstate *kept) { return save(c, kept); }
Status fmi2SetFMUstate(C c, fmi2FMUstate kept) { memcpy(c, kept, sizeof(M)); return fmi2OK; }
Status fmi2FreeFMUstate(C c, fmi2FMUstate *kept) { free(*kept); *kept = NULL; return fmi2OK; }
Status fmi2SerializedFMUstateSize(C c, fmi2FMUstate kept, size_t *n) { *n = sizeof(M); return fmi2OK; }
Status fmi2SerializeFMUstate(C c, fmi2FMUstate kept, fmi2Byte *to, size_t n) { memcpy(to, kept, n); return fmi2OK; }
Status fmi2DeSerializeFMUstate(C c, const fmi2Byte *from, size_t n, fmi2FMUstate *kept) {
    return n == sizeof(M) ? save((M *)from, kept) : fmi2Error;
}
Status fmi2GetDirectionalDerivative(C c, const VR *z, size_t nz, const VR *v, size_t nv, const fmi2Real *dv, fmi2Real *dz) {
    return fmi2Error;
}
Status fmi2EnterEventMode(C c) { return fmi2OK; }
Status fmi2NewDiscreteStates(C c, fmi2EventInfo *e) {
    memset(e, 0, sizeof *e);
    e->nextEventTimeDefined = TICK;
    e->nextEventTime = TICK ? next_tick(c) : 0.0;
    return fmi2OK;
}
Status fmi2EnterContinuousTimeMode(C c) { return fmi2OK; }
Status fmi2CompletedIntegratorStep(C c, fmi2Boolean no, fmi2Boolean *event, fmi2Boolean *end) {
    *event = EVENT;
    *end = fmi2False;
    return fmi2OK;
}
Status fmi2SetTime(C c, fmi2Real t) { ((M *)c)->t = t; return fmi2OK; }
Status fmi2SetContinuousStates(C c, const fmi2Real *x, size_t n) { states(c, x); return n == NX ? fmi2OK : fmi2Error; }
Status fmi2GetDerivatives(C c, fmi2Real *dx, size_t n) {
    M *m = c;
    derive(m, m->t, m->x, dx);
    return fmi2OK;
}
Status fmi2GetEventIndicators(C c, fmi2Real *z, size_t n) { return fmi2OK; }
Status fmi2GetContinuousStates(C c, fmi2Real *x, size_t n) { memcpy(x, ((M *)c)->x, n * sizeof *x); return fmi2OK; }
Status fmi2GetNominalsOfContinuousStates(C c, fmi2Real *x, size_t n) { while (n--) x[n] = 1.0; return fmi2OK; }
Status fmi2SetRealInputDerivatives(C c, const VR *v, size_t n, const fmi2Integer *o, const fmi2Real *x) { return fmi2Error; }
Status fmi2GetRealOutputDerivatives(C c, const VR *v, size_t n, const fmi2Integer *o, fmi2Real *x) { return fmi2Error; }
Status fmi2DoStep(C c, fmi2Real t, fmi2Real h, fmi2Boolean no) { return step(c, t, h); }
Status fmi2CancelStep(C c) { return fmi2Error; }
#define ASK(what, type) Status fmi2Get##what##Status(C c, const fmi2StatusKind k, type *x) { return fmi2Discard; }
ASK(, fmi2Status) ASK(Real, fmi2Real) ASK(Integer, fmi2Integer) ASK(Boolean, fmi2Boolean) ASK(String, fmi2String)
#else
typedef fmi3Instance C;
typedef fmi3Boolean B;
const char *fmi3GetVersion(void) { return fmi3Version; }
C fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String place, B visible, B logs,
                               fmi3InstanceEnvironment e, fmi3LogMessageCallback log) { return make(); }
C fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String place, B visible, B logs, B events, B early,
                              const VR *v, size_t n, fmi3InstanceEnvironment e, fmi3LogMessageCallback log,
                              fmi3IntermediateUpdateCallback update) { return make(); }
C fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String place, B visible, B logs,
                                    fmi3InstanceEnvironment e, fmi3LogMessageCallback log, fmi3ClockUpdateCallback tick,
                                    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock) { return NULL; }
void fmi3FreeInstance(C c) { free(c); }
Status fmi3SetDebugLogging(C c, B on, size_t n, const fmi3String *names) { return fmi3OK; }
Status fmi3EnterInitializationMode(C c, B has, fmi3Float64 tolerance, fmi3Float64 t, B ends, fmi3Float64 end) { return enter(c, t); }
Status fmi3ExitInitializationMode(C c) { ((M *)c)->phase = RUNNING; return fmi3OK; }
Status fmi3Terminate(C c) { return fmi3OK; }
Status fmi3Reset(C c) { return reset(c); }
Status fmi3EnterEventMode(C c) { return fmi3OK; }
Status fmi3EnterStepMode(C c) { return fmi3OK; }
Status fmi3EnterContinuousTimeMode(C c) { return fmi3OK; }
Status fmi3EnterConfigurationMode(C c) { return fmi3Error; }
Status fmi3ExitConfigurationMode(C c) { return fmi3Error; }
Status fmi3GetFloat64(C c, const VR *v, size_t n, fmi3Float64 *x, size_t k) { return get(c, v, n, x); }
Status fmi3SetFloat64(C c, const VR *v, size_t n, const fmi3Float64 *x, size_t k) { return set(c, v, n, x); }
#define NONE(what) \
    Status fmi3Get##what(C c, const VR *v, size_t n, fmi3##what *x, size_t k) { return n ? fmi3Error : fmi3OK; } \
    Status fmi3Set##what(C c, const VR *v, size_t n, const fmi3##what *x, size_t k) { return n ? fmi3Error : fmi3OK; }
NONE(Float32) NONE(Int8) NONE(UInt8) NONE(Int16) NONE(UInt16) NONE(Int32) NONE(UInt32) NONE(Int64) NONE(UInt64)
NONE(Boolean) NONE(String)
Status fmi3GetBinary(C c, const VR *v, size_t n, size_t *s, fmi3Binary *x, size_t k) { return n ? fmi3Error : fmi3OK; }
Status fmi3SetBinary(C c, const VR *v, size_t n, const size_t *s, const fmi3Binary *x, size_t k) { return n ? fmi3Error : fmi3OK; }
Status fmi3GetClock(C c, const VR *v, size_t n, fmi3Clock *x) { return n ? fmi3Error : fmi3OK; }
Status fmi3SetClock(C c, const VR *v, size_t n, const fmi3Clock *x) { return n ? fmi3Error : fmi3OK; }
Status fmi3GetNumberOfVariableDependencies(C c, VR v, size_t *n) { return fmi3Error; }
Status fmi3GetVariableDependencies(C c, VR v, size_t *a, VR *b, size_t *d, fmi3DependencyKind *k, size_t n) { return fmi3Error; }
Status fmi3GetFMUState(C c, fmi3FMUState *kept) { return save(c, kept); }
Status fmi3SetFMUState(C c, fmi3FMUState kept) { memcpy(c, kept, sizeof(M)); return fmi3OK; }
Status fmi3FreeFMUState(C c, fmi3FMUState *kept) { free(*kept); *kept = NULL; return fmi3OK; }
Status fmi3SerializedFMUStateSize(C c, fmi3FMUState kept, size_t *n) { *n = sizeof(M); return fmi3OK; }
Status fmi3SerializeFMUState(C c, fmi3FMUState kept, fmi3Byte *to, size_t n) { memcpy(to, kept, n); return fmi3OK; }
Status fmi3DeserializeFMUState(C c, const fmi3Byte *from, size_t n, fmi3FMUState *kept) {
    return n == sizeof(M) ? save((M *)from, kept) : fmi3Error;
}
Status fmi3GetDirectionalDerivative(C c, const VR *z, size_t nz, const VR *v, size_t nv, const fmi3Float64 *dv, size_t ndv,
                                    fmi3Float64 *dz, size_t ndz) { return fmi3Error; }
Status fmi3GetAdjointDerivative(C c, const VR *z, size_t nz, const VR *v, size_t nv, const fmi3Float64 *dz, size_t ndz,
                                fmi3Float64 *dv, size_t ndv) { return fmi3Error; }
Status fmi3GetIntervalDecimal(C c, const VR *v, size_t n, fmi3Float64 *x, fmi3IntervalQualifier *q) { return fmi3Error; }
Status fmi3GetIntervalFraction(C c, const VR *v, size_t n, fmi3UInt64 *a, fmi3UInt64 *b, fmi3IntervalQualifier *q) { return fmi3Error; }
Status fmi3GetShiftDecimal(C c, const VR *v, size_t n, fmi3Float64 *x) { return fmi3Error; }
Status fmi3GetShiftFraction(C c, const VR *v, size_t n, fmi3UInt64 *a, fmi3UInt64 *b) { return fmi3Error; }
Status fmi3SetIntervalDecimal(C c, const VR *v, size_t n, const fmi3Float64 *x) { return fmi3Error; }
Status fmi3SetIntervalFraction(C c, const VR *v, size_t n, const fmi3UInt64 *a, const fmi3UInt64 *b) { return fmi3Error; }
Status fmi3SetShiftDecimal(C c, const VR *v, size_t n, const fmi3Float64 *x) { return fmi3Error; }
Status fmi3SetShiftFraction(C c, const VR *v, size_t n, const fmi3UInt64 *a, const fmi3UInt64 *b) { return fmi3Error; }
Status fmi3EvaluateDiscreteStates(C c) { return fmi3OK; }
Status fmi3UpdateDiscreteStates(C c, B *more, B *end, B *nominals, B *values, B *defined, fmi3Float64 *t) {
    *more = *end = *nominals = *values = 0;
    *defined = TICK;
    *t = TICK ? next_tick(c) : 0.0;
    return fmi3OK;
}
Status fmi3CompletedIntegratorStep(C c, B no, B *event, B *end) { *event = EVENT; *end = 0; return fmi3OK; }
Status fmi3SetTime(C c, fmi3Float64 t) { ((M *)c)->t = t; return fmi3OK; }
Status fmi3SetContinuousStates(C c, const fmi3Float64 *x, size_t n) { states(c, x); return n == NX ? fmi3OK : fmi3Error; }
Status fmi3GetContinuousStateDerivatives(C c, fmi3Float64 *dx, size_t n) {
    M *m = c;
    derive(m, m->t, m->x, dx);
    return fmi3OK;
}
Status fmi3GetEventIndicators(C c, fmi3Float64 *z, size_t n) { return fmi3OK; }
Status fmi3GetContinuousStates(C c, fmi3Float64 *x, size_t n) { memcpy(x, ((M *)c)->x, n * sizeof *x); return fmi3OK; }
Status fmi3GetNominalsOfContinuousStates(C c, fmi3Float64 *x, size_t n) { while (n--) x[n] = 1.0; return fmi3OK; }
Status fmi3GetNumberOfEventIndicators(C c, size_t *n) { *n = 0; return fmi3OK; }
Status fmi3GetNumberOfContinuousStates(C c, size_t *n) { *n = NX; return fmi3OK; }
Status fmi3GetOutputDerivatives(C c, const VR *v, size_t n, const fmi3Int32 *o, fmi3Float64 *x, size_t k) { return fmi3Error; }
Status fmi3DoStep(C c, fmi3Float64 t, fmi3Float64 h, B no, B *event, B *end, B *early, fmi3Float64 *last) {
    *event = *end = *early = 0;
    *last = t + h;
    return step(c, t, h);
}
Status fmi3ActivateModelPartition(C c, VR v, fmi3Float64 t) { return fmi3Error; }
#endif
