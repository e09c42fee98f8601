/* FMI 1.0, 2.0 and 3.0, co-simulation and model exchange, of the model in model.c, which `kit.py` writes. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef uint32_t VR;
enum { F64, F32, I8, U8, I16, U16, I32, U32, I64, U64, BOOL, ENUM, STR, BIN };
enum { OK, WARNING, DISCARD, ERROR };
typedef struct { size_t size; uint8_t byte[64]; } Bytes;
typedef struct { VR vr; int kind; size_t at, n; bool readable; } Row;
#include "model.c" /* M, ROWS, STATES, NX, NZ and the functions of the model */

static const Row *row(VR v, int kind, bool reads) {
    for (size_t k = 0; k < sizeof ROWS / sizeof *ROWS; k++)
        if (ROWS[k].vr == v) return ROWS[k].kind == kind && (ROWS[k].readable || !reads) ? ROWS + k : NULL;
    return NULL;
}
#define PLACE(c, r) ((char *)(c) + (r)->at)
#define GET(name, T, K) int name(C c, const VR *v, size_t n, T *x) { \
    calc(c); \
    for (size_t i = 0; i < n; i++) { \
        const Row *r = row(v[i], K, true); \
        if (!r) return ERROR; \
        for (size_t j = 0; j < r->n; j++) *x++ = ((T *)PLACE(c, r))[j]; \
    } \
    return OK; }
#define SET(name, T, K) int name(C c, const VR *v, size_t n, const T *x) { \
    for (size_t i = 0; i < n; i++) { \
        const Row *r = row(v[i], K, false); \
        if (!r) return ERROR; \
        for (size_t j = 0; j < r->n; j++) ((T *)PLACE(c, r))[j] = *x++; \
    } \
    return OK; }
#define BOTH(name, T, K) GET(fmi3Get##name, T, K) SET(fmi3Set##name, T, K)
BOTH(Float64, double, F64) BOTH(Float32, float, F32) BOTH(Int8, int8_t, I8) BOTH(UInt8, uint8_t, U8)
BOTH(Int16, int16_t, I16) BOTH(UInt16, uint16_t, U16) BOTH(Int32, int32_t, I32) BOTH(UInt32, uint32_t, U32)
BOTH(UInt64, uint64_t, U64) BOTH(Boolean, bool, BOOL)
static GET(get_int64, int64_t, I64) static SET(set_int64, int64_t, I64)
static GET(get_item, int64_t, ENUM) static SET(set_item, int64_t, ENUM)
int fmi3GetInt64(C c, const VR *v, size_t n, int64_t *x) {
    if (n && row(*v, ENUM, true)) return get_item(c, v, n, x);
    return get_int64(c, v, n, x);
}
int fmi3SetInt64(C c, const VR *v, size_t n, const int64_t *x) {
    if (n && row(*v, ENUM, false)) return set_item(c, v, n, x);
    return set_int64(c, v, n, x);
}
int fmi3GetString(C c, const VR *v, size_t n, const char **x) {
    calc(c);
    for (size_t i = 0; i < n; i++) {
        const Row *r = row(v[i], STR, true);
        if (!r) return ERROR;
        x[i] = PLACE(c, r);
    }
    return OK;
}
int fmi3SetString(C c, const VR *v, size_t n, const char *const *x) {
    for (size_t i = 0; i < n; i++) {
        const Row *r = row(v[i], STR, false);
        if (!r) return ERROR;
        strncpy(PLACE(c, r), x[i] ? x[i] : "", 63);
    }
    return OK;
}
int fmi3GetBinary(C c, const VR *v, size_t n, size_t *size, const uint8_t **x) {
    calc(c);
    for (size_t i = 0; i < n; i++) {
        const Row *r = row(v[i], BIN, true);
        if (!r) return ERROR;
        size[i] = ((Bytes *)PLACE(c, r))->size;
        x[i] = ((Bytes *)PLACE(c, r))->byte;
    }
    return OK;
}
int fmi3SetBinary(C c, const VR *v, size_t n, const size_t *size, const uint8_t *const *x) {
    for (size_t i = 0; i < n; i++) {
        const Row *r = row(v[i], BIN, false);
        if (!r || size[i] > 64) return ERROR;
        ((Bytes *)PLACE(c, r))->size = size[i];
        memcpy(((Bytes *)PLACE(c, r))->byte, x[i], size[i]);
    }
    return OK;
}
/* FMI 2.0 and 1.0 have four types; their integers are int, also those of enumerations, FMI 2.0's Booleans too. */
#define FEW(name, T, K, S) \
    int fmi2Get##name(C c, const VR *v, size_t n, T *x) { \
        for (size_t i = 0; i < n; i++) { S one; if (fmi3Get##K(c, v + i, 1, &one)) return ERROR; x[i] = one; } return OK; } \
    int fmi2Set##name(C c, const VR *v, size_t n, const T *x) { \
        for (size_t i = 0; i < n; i++) { S one = x[i]; if (fmi3Set##K(c, v + i, 1, &one)) return ERROR; } return OK; }
static int fmi3GetWhole(C c, const VR *v, size_t n, int64_t *x) {
    int one;
    if (row(*v, ENUM, true)) return get_item(c, v, n, x);
    if (fmi3GetInt32(c, v, n, &one)) return ERROR;
    *x = one;
    return OK;
}
static int fmi3SetWhole(C c, const VR *v, size_t n, const int64_t *x) {
    int one = *x;
    return row(*v, ENUM, false) ? set_item(c, v, n, x) : fmi3SetInt32(c, v, n, &one);
}
FEW(Integer, int, Whole, int64_t) FEW(Boolean, int, Boolean, bool)
int fmi2GetReal(C c, const VR *v, size_t n, double *x) { return fmi3GetFloat64(c, v, n, x); }
/* Derivatives of inputs are those at the start of the next step; a new value ends them. */
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) {
    for (size_t i = 0; i < n && v[i] < 64; i++) memset(((M *)c)->input_slopes[v[i]], 0, 3 * sizeof(double));
    return fmi3SetFloat64(c, v, n, x);
}
int fmi2SetRealInputDerivatives(C c, const VR *v, size_t n, const int *order, const double *x) {
    for (size_t i = 0; i < n; i++) {
        if (v[i] > 63 || order[i] > 2) return ERROR;
        double *slopes = ((M *)c)->input_slopes[v[i]];
        fmi3GetFloat64(c, v + i, 1, slopes);
        slopes[order[i]] = x[i];
    }
    return OK;
}
static void follow_slopes(M *m, double since) {
#ifndef IGNORES_SLOPES
    for (VR v = 0; v < 64; v++) {
        const double *s = m->input_slopes[v];
        const double u = s[0] + since * (s[1] + 0.5 * since * s[2]);
        if (s[1] != 0 || s[2] != 0) fmi3SetFloat64(m, &v, 1, &u);
    }
#endif
}
int fmi2GetString(C c, const VR *v, size_t n, const char **x) { return fmi3GetString(c, v, n, x); }
int fmi2SetString(C c, const VR *v, size_t n, const char *const *x) { return fmi3SetString(c, v, n, x); }

static C make(void) { M *m = calloc(1, sizeof(M)); m->next = INFINITY; defaults(m); return m; }
static void set_states(M *m, const double *x) { for (int k = 0; k < NX; k++) *(double *)((char *)m + STATES[k]) = x[k]; }
static void get_states(M *m, double *x) { for (int k = 0; k < NX; k++) x[k] = *(double *)((char *)m + STATES[k]); }
static void begin(M *m, double start) { m->time = start; m->initializing = true; calc(m); }
static void started(M *m) { calc(m); start(m); m->initializing = false; }
/* Runge and Kutta's fourth order in steps of at most 1 ms, so that the error of a step is that of rounding. */
static void advance(M *m, double t, double h) {
    double x[NX + 1], k[4][NX + 1], y[NX + 1];
    const double part[] = {0, 0.5, 0.5, 1};
    const int n = NX ? (int)ceil(h / 1e-3 - 1e-9) : 0;
    for (int q = 0; q < n; q++) {
        const double d = h / n;
        get_states(m, x);
        for (int s = 0; s < 4; s++) {
            for (int i = 0; i < NX; i++) y[i] = x[i] + (s ? part[s] * d * k[s - 1][i] : 0);
            set_states(m, y);
            m->time = t + (q + part[s]) * d;
            follow_slopes(m, (q + part[s]) * d);
            rates(m, k[s]);
        }
        for (int i = 0; i < NX; i++) y[i] = x[i] + d / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
        set_states(m, y);
    }
    m->time = t + h;
    step(m, t, h);
}
const char *fmi3GetVersion(void) { return "3.0"; }
const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
C fmi3InstantiateCoSimulation(void) { return make(); }
C fmi3InstantiateModelExchange(void) { return make(); }
C fmi2Instantiate(void) { return make(); }
void fmi3FreeInstance(C c) { free(c); }
void fmi2FreeInstance(C c) { free(c); }
#define FINE(name) int name(void) { return OK; }
#define NONE(name) int name(void) { return ERROR; }
FINE(fmi3SetDebugLogging) FINE(fmi3Terminate) FINE(fmi3EnterEventMode) FINE(fmi3EnterStepMode)
FINE(fmi3EnterContinuousTimeMode) FINE(fmi2SetDebugLogging) FINE(fmi2Terminate) FINE(fmi2EnterEventMode)
FINE(fmi2EnterContinuousTimeMode)
int fmi3Reset(C c) { memset(c, 0, sizeof(M)); ((M *)c)->next = INFINITY; defaults(c); return OK; }
int fmi2Reset(C c) { return fmi3Reset(c); }
int fmi3EnterInitializationMode(C c, bool given, double tolerance, double from) { (void)given; (void)tolerance; begin(c, from); return OK; }
int fmi3ExitInitializationMode(C c) { started(c); return OK; }
int fmi2SetupExperiment(C c, int given, double tolerance, double from) { (void)given; (void)tolerance; ((M *)c)->time = from; return OK; }
int fmi2EnterInitializationMode(C c) { begin(c, ((M *)c)->time); return OK; }
int fmi2ExitInitializationMode(C c) { started(c); return OK; }
static int one_step(M *m, double t, double h) { advance(m, t, h); return m->end ? DISCARD : OK; }
int fmi3DoStep(C c, double t, double h, bool no, bool *event, bool *end, bool *early, double *last) {
    M *m = c;
    (void)no;
    advance(m, t, h);
    *event = *early = false;
    *end = m->end;
    *last = t + h;
    return OK;
}
int fmi2DoStep(C c, double t, double h, int no) { (void)no; return one_step(c, t, h); }
int fmi2GetBooleanStatus(C c, int kind, int *x) { (void)kind; *x = ((M *)c)->end; return OK; }
int fmi2GetRealStatus(C c, int kind, double *x) { (void)kind; *x = ((M *)c)->time; return OK; }
NONE(fmi2GetStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetStringStatus) NONE(fmi2CancelStep)

/* -- model exchange -- */
static void update(M *m) { m->changed = m->more = m->ask = false; calc(m); event(m); }
int fmi3UpdateDiscreteStates(C c, bool *more, bool *end, bool *nominals, bool *states, bool *defined, double *next) {
    M *m = c;
    update(m);
    *more = m->more; *end = m->end; *nominals = false; *states = m->changed;
    *defined = isfinite(m->next); *next = m->next;
    return OK;
}
typedef struct { int more, end, nominals, states, defined; double next; } Info;
int fmi2NewDiscreteStates(C c, Info *e) {
    M *m = c;
    update(m);
    *e = (Info){m->more, m->end, 0, m->changed, isfinite(m->next), m->next};
    return OK;
}
int fmi3CompletedIntegratorStep(C c, bool no, bool *ask, bool *end) { M *m = c; (void)no; calc(m); completed(m); *ask = m->ask; *end = m->end; return OK; }
int fmi2CompletedIntegratorStep(C c, int no, int *ask, int *end) { M *m = c; (void)no; calc(m); completed(m); *ask = m->ask; *end = m->end; return OK; }
int fmi3SetTime(C c, double t) { ((M *)c)->time = t; return OK; }
int fmi3SetContinuousStates(C c, const double *x) { set_states(c, x); return OK; }
int fmi3GetContinuousStates(C c, double *x) { get_states(c, x); return OK; }
int fmi3GetContinuousStateDerivatives(C c, double *x) { rates(c, x); return OK; }
int fmi3GetEventIndicators(C c, double *z) { calc(c); zeros(c, z); return OK; }
int fmi3GetNominalsOfContinuousStates(C c, double *x) { (void)c; for (int k = 0; k < NX; k++) x[k] = 1; return OK; }
int fmi3GetNumberOfEventIndicators(C c, size_t *n) { (void)c; *n = NZ; return OK; }
int fmi3GetNumberOfContinuousStates(C c, size_t *n) { (void)c; *n = NX; return OK; }
int fmi2SetTime(C c, double t) { return fmi3SetTime(c, t); }
int fmi2SetContinuousStates(C c, const double *x) { set_states(c, x); return OK; }
int fmi2GetContinuousStates(C c, double *x) { get_states(c, x); return OK; }
int fmi2GetDerivatives(C c, double *x) { rates(c, x); return OK; }
int fmi2GetEventIndicators(C c, double *z) { return fmi3GetEventIndicators(c, z); }
int fmi2GetNominalsOfContinuousStates(C c, double *x) { return fmi3GetNominalsOfContinuousStates(c, x); }

/* -- state of the FMU -- */
int fmi3GetFMUState(C c, void **s) { if (!*s) *s = malloc(sizeof(M)); memcpy(*s, c, sizeof(M)); return OK; }
int fmi3SetFMUState(C c, void *s) { memcpy(c, s, sizeof(M)); return OK; }
int fmi3FreeFMUState(C c, void **s) { (void)c; free(*s); *s = NULL; return OK; }
int fmi2GetFMUstate(C c, void **s) { return fmi3GetFMUState(c, s); }
int fmi2SetFMUstate(C c, void *s) { return fmi3SetFMUState(c, s); }
int fmi2FreeFMUstate(C c, void **s) { return fmi3FreeFMUState(c, s); }
NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate) NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative) NONE(fmi2GetRealOutputDerivatives)
NONE(fmi3SerializedFMUStateSize) NONE(fmi3SerializeFMUState) NONE(fmi3DeserializeFMUState)
NONE(fmi3GetDirectionalDerivative) NONE(fmi3GetAdjointDerivative) NONE(fmi3GetOutputDerivatives)
NONE(fmi3InstantiateScheduledExecution) NONE(fmi3GetClock) NONE(fmi3SetClock)
NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetVariableDependencies) NONE(fmi3EnterConfigurationMode)
NONE(fmi3ExitConfigurationMode) NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction) NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction) NONE(fmi3EvaluateDiscreteStates) NONE(fmi3ActivateModelPartition)

/* -- FMI 1.0 -- */
#define JOIN(a, b) a##_##b
#define PREFIX(a, b) JOIN(a, b)
#define F(name) PREFIX(NAME, name)
typedef struct { char done, references, states, end, defined; double next; } Info1;
static void update1(M *m, Info1 *e) {
    bool any = false;
    do { update(m); any |= m->changed; } while (m->more);
    *e = (Info1){1, 0, any, m->end, isfinite(m->next), m->next};
}
const char *F(fmiGetVersion)(void) { return "1.0"; }
const char *F(fmiGetTypesPlatform)(void) { return "standard32"; }
const char *F(fmiGetModelTypesPlatform)(void) { return "standard32"; }
C F(fmiInstantiateSlave)(void) { return make(); }
C F(fmiInstantiateModel)(void) { return make(); }
void F(fmiFreeSlaveInstance)(C c) { free(c); }
void F(fmiFreeModelInstance)(C c) { free(c); }
int F(fmiSetDebugLogging)(void) { return OK; }
int F(fmiInitializeSlave)(C c, double from) { begin(c, from); started(c); return OK; }
int F(fmiTerminateSlave)(void) { return OK; }
int F(fmiTerminate)(void) { return OK; }
int F(fmiResetSlave)(C c) { return fmi3Reset(c); }
int F(fmiDoStep)(C c, double t, double h) { return one_step(c, t, h); }
int F(fmiCancelStep)(void) { return ERROR; }
int F(fmiSetRealInputDerivatives)(void) { return ERROR; }
int F(fmiGetRealOutputDerivatives)(void) { return ERROR; }
int F(fmiGetStatus)(void) { return ERROR; }
int F(fmiGetRealStatus)(C c, int kind, double *x) { (void)kind; *x = ((M *)c)->time; return OK; }
int F(fmiGetIntegerStatus)(void) { return ERROR; }
int F(fmiGetBooleanStatus)(void) { return ERROR; }
int F(fmiGetStringStatus)(void) { return ERROR; }
int F(fmiInitialize)(C c, char given, double tolerance, Info1 *e) { M *m = c; (void)given; (void)tolerance; begin(m, m->time); started(m); update1(m, e); return OK; }
int F(fmiEventUpdate)(C c, char between, Info1 *e) { (void)between; update1(c, e); return OK; }
int F(fmiCompletedIntegratorStep)(C c, char *ask) { M *m = c; calc(m); completed(m); *ask = m->ask; return OK; }
int F(fmiSetTime)(C c, double t) { return fmi3SetTime(c, t); }
int F(fmiSetContinuousStates)(C c, const double *x) { set_states(c, x); return OK; }
int F(fmiGetContinuousStates)(C c, double *x) { get_states(c, x); return OK; }
int F(fmiGetDerivatives)(C c, double *x) { rates(c, x); return OK; }
int F(fmiGetEventIndicators)(C c, double *z) { return fmi3GetEventIndicators(c, z); }
int F(fmiGetNominalContinuousStates)(C c, double *x) { return fmi3GetNominalsOfContinuousStates(c, x); }
int F(fmiGetStateValueReferences)(C c, VR *v) { (void)c; for (int k = 0; k < NX; k++) v[k] = STATE_VRS[k]; return OK; }
int F(fmiGetReal)(C c, const VR *v, size_t n, double *x) { return fmi3GetFloat64(c, v, n, x); }
int F(fmiSetReal)(C c, const VR *v, size_t n, const double *x) { return fmi3SetFloat64(c, v, n, x); }
int F(fmiGetInteger)(C c, const VR *v, size_t n, int *x) { return fmi2GetInteger(c, v, n, x); }
int F(fmiSetInteger)(C c, const VR *v, size_t n, const int *x) { return fmi2SetInteger(c, v, n, x); }
int F(fmiGetBoolean)(C c, const VR *v, size_t n, bool *x) { return fmi3GetBoolean(c, v, n, x); }
int F(fmiSetBoolean)(C c, const VR *v, size_t n, const bool *x) { return fmi3SetBoolean(c, v, n, x); }
int F(fmiGetString)(C c, const VR *v, size_t n, const char **x) { return fmi3GetString(c, v, n, x); }
int F(fmiSetString)(C c, const VR *v, size_t n, const char *const *x) { return fmi3SetString(c, v, n, x); }
