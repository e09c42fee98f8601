/* FMUs whose values have a meaning beyond their numbers: -DFMI=1 negated aliases, 2 units, 3 exact types, 4 a bus node. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
enum { OK, WARNING, DISCARD, ERROR };
#define FINE(name) int name() { return OK; }
#define NONE(name) int name() { return ERROR; }

#if FMI == 1 /* dx/dt = u - x, y = 2u, in co-simulation and model exchange */
typedef struct { void *logger, *allocate, *release, *finished; } Callbacks;
typedef struct { char converged, references, states, end, defined; double time; } EventInfo;
typedef struct { double real[4]; int whole; char truth; } M;
enum { X, U, Y, RATE };
#define F(name) meaning_fmi##name
static M *make(void) { M *m = calloc(1, sizeof(M)); m->real[U] = 3; m->whole = 7; m->truth = 1; return m; }
static int none(void) { return ERROR; }
static void pass(M *m) { m->real[Y] = 2 * m->real[U]; m->real[RATE] = m->real[U] - m->real[X]; }
const char *F(GetTypesPlatform)(void) { return "standard32"; }
const char *F(GetModelTypesPlatform)(void) { return "standard32"; }
const char *F(GetVersion)(void) { return "1.0"; }
int F(SetDebugLogging)(C c, char on) { return OK; }
C F(InstantiateSlave)(const char *n, const char *g, const char *l, const char *t, double o, char v, char i, Callbacks k,
                      char d) { return make(); }
int F(InitializeSlave)(C c, double t, char d, double s) { return OK; }
int F(TerminateSlave)(C c) { return OK; }
int F(ResetSlave)(C c) { return ERROR; }
void F(FreeSlaveInstance)(C c) { free(c); }
int F(DoStep)(C c, double t, double h, char n) { M *m = c; m->real[X] += h * (m->real[U] - m->real[X]); return OK; }
int F(SetRealInputDerivatives)(void) { return none(); }
int F(GetRealOutputDerivatives)(void) { return none(); }
int F(CancelStep)(void) { return none(); }
int F(GetStatus)(void) { return none(); }
int F(GetRealStatus)(void) { return none(); }
int F(GetIntegerStatus)(void) { return none(); }
int F(GetBooleanStatus)(void) { return none(); }
int F(GetStringStatus)(void) { return none(); }
C F(InstantiateModel)(const char *n, const char *g, Callbacks k, char d) { return make(); }
void F(FreeModelInstance)(C c) { free(c); }
int F(SetTime)(C c, double t) { return OK; }
int F(SetContinuousStates)(C c, const double x[], size_t n) { memcpy(((M *)c)->real, x, n * sizeof *x); return OK; }
int F(GetContinuousStates)(C c, double x[], size_t n) { memcpy(x, ((M *)c)->real, n * sizeof *x); return OK; }
int F(GetNominalContinuousStates)(C c, double x[], size_t n) { while (n--) x[n] = 1; return OK; }
int F(GetStateValueReferences)(C c, VR r[], size_t n) { while (n--) r[n] = n; return OK; }
int F(GetDerivatives)(C c, double dx[], size_t n) { pass(c); if (n) dx[0] = ((M *)c)->real[RATE]; return OK; }
int F(GetEventIndicators)(C c, double z[], size_t n) { return OK; }
int F(CompletedIntegratorStep)(C c, char *event) { *event = 0; return OK; }
int F(Initialize)(C c, char d, double t, EventInfo *e) { memset(e, 0, sizeof *e); e->converged = 1; return OK; }
int F(EventUpdate)(C c, char i, EventInfo *e) { memset(e, 0, sizeof *e); e->converged = 1; return OK; }
int F(Terminate)(C c) { return OK; }
int F(GetReal)(C c, const VR r[], size_t n, double v[]) { pass(c); while (n--) v[n] = ((M *)c)->real[r[n]]; return OK; }
int F(SetReal)(C c, const VR r[], size_t n, const double v[]) { while (n--) ((M *)c)->real[r[n]] = v[n]; return OK; }
int F(GetInteger)(C c, const VR r[], size_t n, int v[]) { while (n--) v[n] = ((M *)c)->whole; return OK; }
int F(SetInteger)(C c, const VR r[], size_t n, const int v[]) { while (n--) ((M *)c)->whole = v[n]; return OK; }
int F(GetBoolean)(C c, const VR r[], size_t n, char v[]) { while (n--) v[n] = ((M *)c)->truth; return OK; }
int F(SetBoolean)(C c, const VR r[], size_t n, const char v[]) { while (n--) ((M *)c)->truth = v[n]; return OK; }
int F(GetString)(void) { return none(); }
int F(SetString)(void) { return none(); }

#elif FMI == 2 /* y = gain u; on = t >= at, count = t / at, held = 0.5 count; it logs as often as it is told */
typedef void (*Logger)(C, const char *, int, const char *, const char *, ...);
typedef struct { Logger logger; void *allocate, *release, *finished; C environment; } Callbacks;
typedef struct { double real[5]; int on, whole[2]; const Callbacks *call; char name[50]; } M;
enum { IN, OUT, GAIN, AT, HELD, COUNT = 0, SAYS };
C fmi2Instantiate(const char *n, int t, const char *g, const char *r, const Callbacks *f, int v, int l) {
    M *m = calloc(1, sizeof(M));
    m->call = f;
    m->real[GAIN] = m->real[AT] = 1;
    strncpy(m->name, n, sizeof m->name - 1);
    return m;
}
void fmi2FreeInstance(C c) { free(c); }
int fmi2GetReal(C c, const VR *v, size_t n, double *x) {
    M *m = c;
    m->real[OUT] = m->real[GAIN] * m->real[IN];
    while (n--) x[n] = m->real[v[n]];
    return OK;
}
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((M *)c)->real[v[n]] = x[n]; return OK; }
int fmi2GetInteger(C c, const VR *v, size_t n, int *x) { while (n--) x[n] = ((M *)c)->whole[v[n]]; return OK; }
int fmi2SetInteger(C c, const VR *v, size_t n, const int *x) { while (n--) ((M *)c)->whole[v[n]] = x[n]; return OK; }
int fmi2GetBoolean(C c, const VR *v, size_t n, int *x) { while (n--) x[n] = ((M *)c)->on; return OK; }
int fmi2DoStep(C c, double t, double h, int no) {
    M *m = c;
    m->on = t + h >= m->real[AT] - 1e-9;
    m->whole[COUNT] = (int)((t + h + 1e-9) / m->real[AT]);
    m->real[HELD] = 0.5 * m->whole[COUNT];
    for (int k = 0; k < m->whole[SAYS]; k++) m->call->logger(m->call->environment, m->name, OK, "all", "%d at %g", k, t);
    return OK;
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
FINE(fmi2SetupExperiment) FINE(fmi2EnterInitializationMode) FINE(fmi2ExitInitializationMode) FINE(fmi2Terminate)
FINE(fmi2Reset) FINE(fmi2SetDebugLogging)
NONE(fmi2GetString) NONE(fmi2SetString) NONE(fmi2SetBoolean) NONE(fmi2GetFMUstate) NONE(fmi2SetFMUstate)
NONE(fmi2FreeFMUstate) NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate) NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative) NONE(fmi2SetRealInputDerivatives) NONE(fmi2GetRealOutputDerivatives)
NONE(fmi2CancelStep) NONE(fmi2GetStatus) NONE(fmi2GetRealStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)

#elif FMI == 3 /* each output, of an even reference, has the value of the input before it; inputs cannot be read */
typedef struct { double real; int64_t whole; uint64_t natural; _Bool truth; char text[99]; uint8_t raw[99]; size_t size; } M;
C fmi3InstantiateCoSimulation(void) {
    M *m = calloc(1, sizeof(M));
    m->real = 5; m->whole = -9007199254740993; m->natural = 18446744073709551615u; m->truth = 1;
    strcpy(m->text, "000"); m->raw[0] = 10; m->size = 1;
    return m;
}
void fmi3FreeInstance(C c) { free(c); }
#define BOTH(type, ctype, field) \
    int fmi3Get##type(C c, const VR *v, size_t n, ctype *x, size_t k) { \
        for (size_t i = 0; i < n; i++) { if (v[i] % 2) return ERROR; x[i] = ((M *)c)->field; } return OK; } \
    int fmi3Set##type(C c, const VR *v, size_t n, const ctype *x, size_t k) { \
        for (size_t i = 0; i < n; i++) ((M *)c)->field = x[i]; return OK; }
BOTH(Float64, double, real)
BOTH(Int64, int64_t, whole)
BOTH(UInt64, uint64_t, natural)
BOTH(Boolean, _Bool, truth)
int fmi3GetString(C c, const VR *v, size_t n, const char **x, size_t k) { *x = ((M *)c)->text; return *v % 2 ? ERROR : OK; }
int fmi3SetString(C c, const VR *v, size_t n, const char *const *x, size_t k) { strncpy(((M *)c)->text, *x, 98); return OK; }
int fmi3GetBinary(C c, const VR *v, size_t n, size_t *s, const uint8_t **x, size_t k) {
    *s = ((M *)c)->size; *x = ((M *)c)->raw;
    return *v % 2 ? ERROR : OK;
}
int fmi3SetBinary(C c, const VR *v, size_t n, const size_t *s, const uint8_t *const *x, size_t k) {
    memcpy(((M *)c)->raw, *x, *s); ((M *)c)->size = *s;
    return OK;
}
int fmi3DoStep(C c, double t, double h, _Bool no, _Bool *e, _Bool *end, _Bool *early, double *last) {
    *e = *end = *early = 0; *last = t + h;
    return OK;
}
const char *fmi3GetVersion(void) { return "3.0"; }
FINE(fmi3EnterEventMode) FINE(fmi3EnterInitializationMode) FINE(fmi3EnterStepMode) FINE(fmi3ExitInitializationMode)
FINE(fmi3Reset) FINE(fmi3SetDebugLogging) FINE(fmi3Terminate)
NONE(fmi3ActivateModelPartition) NONE(fmi3CompletedIntegratorStep) NONE(fmi3DeserializeFMUState)
NONE(fmi3EnterConfigurationMode) NONE(fmi3EnterContinuousTimeMode) NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3ExitConfigurationMode) NONE(fmi3FreeFMUState) NONE(fmi3GetAdjointDerivative) NONE(fmi3GetClock)
NONE(fmi3GetContinuousStateDerivatives) NONE(fmi3GetContinuousStates) NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetEventIndicators) NONE(fmi3GetFMUState) NONE(fmi3GetFloat32) NONE(fmi3GetInt16) NONE(fmi3GetInt32)
NONE(fmi3GetInt8) NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction) NONE(fmi3GetNominalsOfContinuousStates)
NONE(fmi3GetNumberOfContinuousStates) NONE(fmi3GetNumberOfEventIndicators) NONE(fmi3GetNumberOfVariableDependencies)
NONE(fmi3GetOutputDerivatives) NONE(fmi3GetShiftDecimal) NONE(fmi3GetShiftFraction) NONE(fmi3GetUInt16)
NONE(fmi3GetUInt32) NONE(fmi3GetUInt8) NONE(fmi3GetVariableDependencies) NONE(fmi3InstantiateModelExchange)
NONE(fmi3InstantiateScheduledExecution) NONE(fmi3SerializeFMUState) NONE(fmi3SerializedFMUStateSize)
NONE(fmi3SetClock) NONE(fmi3SetContinuousStates) NONE(fmi3SetFMUState) NONE(fmi3SetFloat32) NONE(fmi3SetInt16)
NONE(fmi3SetInt32) NONE(fmi3SetInt8) NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction)
NONE(fmi3SetShiftDecimal) NONE(fmi3SetShiftFraction) NONE(fmi3SetTime) NONE(fmi3SetUInt16) NONE(fmi3SetUInt32)
NONE(fmi3SetUInt8) NONE(fmi3UpdateDiscreteStates)

#else /* a node of a bus: it sends two bytes each 0.3 s, and counts what arrives; clocked values only at their ticks */
typedef struct { int receives, sends, evaluated, sent, arrived; double next; uint8_t raw[9]; size_t size; uint8_t out[2]; } M;
enum { RX = 1, TX, RX_CLOCK, TX_CLOCK, ARRIVED, BYTES };
C fmi3InstantiateCoSimulation(void) { M *m = calloc(1, sizeof(M)); m->sends = 1; m->next = 0.3; return m; }
void fmi3FreeInstance(C c) { free(c); }
int fmi3GetBinary(C c, const VR *v, size_t n, size_t *s, const uint8_t **x, size_t k) {
    M *m = c;
    if (*v != TX || !m->sends) return ERROR;
    m->evaluated = 1; m->out[0] = 0xca; m->out[1] = 0xfe; *s = 2; *x = m->out;
    return OK;
}
int fmi3SetBinary(C c, const VR *v, size_t n, const size_t *s, const uint8_t *const *x, size_t k) {
    M *m = c;
    if (*v != RX || !m->receives) return ERROR;
    memcpy(m->raw, *x, *s); m->size = *s;
    return OK;
}
int fmi3GetInt32(C c, const VR *v, size_t n, int32_t *x, size_t k) { while (n--) x[n] = ((M *)c)->arrived; return OK; }
int fmi3SetClock(C c, const VR *v, size_t n, const _Bool *x) { if (*v != RX_CLOCK) return ERROR; ((M *)c)->receives = *x; return OK; }
int fmi3GetClock(C c, const VR *v, size_t n, _Bool *x) { while (n--) x[n] = ((M *)c)->sends; return OK; }
int fmi3UpdateDiscreteStates(C c, _Bool *more, _Bool *end, _Bool *nominals, _Bool *states, _Bool *defined, double *t) {
    M *m = c;
    if (m->receives) m->arrived += m->size == 2; /* what is not set again is gone */
    m->size = m->receives = m->sends = m->evaluated = 0;
    *more = *end = *nominals = *states = *defined = 0;
    return OK;
}
int fmi3DoStep(C c, double t, double h, _Bool no, _Bool *e, _Bool *end, _Bool *early, double *last) {
    M *m = c;
    *e = t + h >= m->next - 1e-9;
    if (*e) { m->next += 0.3; m->sends = 1; }
    *end = *early = 0; *last = t + h;
    return OK;
}
const char *fmi3GetVersion(void) { return "3.0"; }
FINE(fmi3EnterEventMode) FINE(fmi3EnterInitializationMode) FINE(fmi3EnterStepMode) FINE(fmi3ExitInitializationMode)
FINE(fmi3Reset) FINE(fmi3SetDebugLogging) FINE(fmi3Terminate)
NONE(fmi3ActivateModelPartition) NONE(fmi3CompletedIntegratorStep) NONE(fmi3DeserializeFMUState)
NONE(fmi3EnterConfigurationMode) NONE(fmi3EnterContinuousTimeMode) NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3ExitConfigurationMode) NONE(fmi3FreeFMUState) NONE(fmi3GetAdjointDerivative) NONE(fmi3GetBoolean)
NONE(fmi3GetContinuousStateDerivatives) NONE(fmi3GetContinuousStates) NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetEventIndicators) NONE(fmi3GetFMUState) NONE(fmi3GetFloat32) NONE(fmi3GetFloat64) NONE(fmi3GetInt16)
NONE(fmi3GetInt64) NONE(fmi3GetInt8) NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction)
NONE(fmi3GetNominalsOfContinuousStates) NONE(fmi3GetNumberOfContinuousStates) NONE(fmi3GetNumberOfEventIndicators)
NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetOutputDerivatives) NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction) NONE(fmi3GetString) NONE(fmi3GetUInt16) NONE(fmi3GetUInt32) NONE(fmi3GetUInt64)
NONE(fmi3GetUInt8) NONE(fmi3GetVariableDependencies) NONE(fmi3InstantiateModelExchange)
NONE(fmi3InstantiateScheduledExecution) NONE(fmi3SerializeFMUState) NONE(fmi3SerializedFMUStateSize)
NONE(fmi3SetBoolean) NONE(fmi3SetContinuousStates) NONE(fmi3SetFMUState) NONE(fmi3SetFloat32) NONE(fmi3SetFloat64)
NONE(fmi3SetInt16) NONE(fmi3SetInt32) NONE(fmi3SetInt64) NONE(fmi3SetInt8) NONE(fmi3SetIntervalDecimal)
NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal) NONE(fmi3SetShiftFraction) NONE(fmi3SetString)
NONE(fmi3SetTime) NONE(fmi3SetUInt16) NONE(fmi3SetUInt32) NONE(fmi3SetUInt64) NONE(fmi3SetUInt8)
#endif
