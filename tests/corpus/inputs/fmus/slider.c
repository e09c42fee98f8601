/* A sliding mass, FMI 2.0 and 3.0, co-simulation and model exchange: v' = (gain/mass)·force − damping·v + offset, x' = v.
 * It crashes in a step with mass < fragile. With a file resources/follow it takes start values from its own
 * modelDescription.xml, otherwise those below. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
enum { FORCE, X, V, DER_X, DER_V, MASS, GAIN, DAMPING, OFFSET, IDLE, FRAGILE, V_START, LATE, REALS };
typedef struct { double real[REALS]; int started; } M;
typedef struct { int more, end, nominals, states, defined; double time; } EventInfo;
static const char *NAMES[REALS] = {"force", "position", "velocity", "", "", "mass", "gain", "damping", "offset", "idle",
                                   "fragile", "velocity_start", "late"};

static void follow(M *m, const char *place) {
    char path[4096], *text, *at, *end;
    snprintf(path, sizeof path, "%s/follow", strncmp(place, "file://", 7) ? place : place + 7);
    FILE *f = fopen(path, "r");
    if (!f) return;
    fclose(f);
    snprintf(path, sizeof path, "%s/../modelDescription.xml", strncmp(place, "file://", 7) ? place : place + 7);
    if (!(f = fopen(path, "r"))) return;
    text = calloc(1, 1 << 20);
    if (fread(text, 1, (1 << 20) - 1, f))
        for (int i = MASS; i < REALS; i++) {
            snprintf(path, sizeof path, "name=\"%s\"", NAMES[i]);
            if ((at = strstr(text, path)) && (end = strstr(at, "start=\""))) m->real[i] = atof(end + 7);
        }
    free(text);
    fclose(f);
}
static M *make(const char *place) {
    M *m = calloc(1, sizeof(M));
    m->real[MASS] = 1; m->real[GAIN] = 2; m->real[DAMPING] = 0.5; m->real[LATE] = 1;
    follow(m, place);
    return m;
}
static void slopes(M *m) {
    m->real[DER_X] = m->real[V];
    m->real[DER_V] = m->real[GAIN] / m->real[MASS] * m->real[FORCE] - m->real[DAMPING] * m->real[V] + m->real[OFFSET];
}
static int step(M *m, double h) {
    if (m->real[MASS] < m->real[FRAGILE]) abort();
    int n = 4;
    for (int i = 0; i < n; i++) { /* midpoint rule */
        double x = m->real[X], v = m->real[V];
        slopes(m);
        m->real[X] = x + 0.5 * h / n * m->real[DER_X]; m->real[V] = v + 0.5 * h / n * m->real[DER_V];
        slopes(m);
        m->real[X] = x + h / n * m->real[DER_X]; m->real[V] = v + h / n * m->real[DER_V];
    }
    return 0;
}
static int get(M *m, const VR *v, size_t n, double *x) {
    if (!m->started) m->real[V] = m->real[V_START];
    slopes(m);
    while (n--) x[n] = m->real[v[n]];
    return 0;
}
static int leave(M *m) { m->real[V] = m->real[V_START]; m->started = 1; return 0; }

C fmi2Instantiate(const char *n, int t, const char *g, const char *place, const void *f, int v, int l) { return make(place); }
C fmi3InstantiateCoSimulation(const char *n, const char *t, const char *place) { return make(place); }
C fmi3InstantiateModelExchange(const char *n, const char *t, const char *place) { return make(place); }
void fmi2FreeInstance(C c) { free(c); }
void fmi3FreeInstance(C c) { free(c); }
#define FINE(name) int name(void) { return 0; }
FINE(fmi2SetupExperiment) FINE(fmi2EnterInitializationMode) FINE(fmi2Terminate) FINE(fmi2Reset)
FINE(fmi2EnterEventMode) FINE(fmi2EnterContinuousTimeMode) FINE(fmi2SetTime) FINE(fmi2SetDebugLogging)
FINE(fmi3EnterInitializationMode) FINE(fmi3Terminate) FINE(fmi3Reset) FINE(fmi3SetDebugLogging)
FINE(fmi3EnterEventMode) FINE(fmi3EnterStepMode) FINE(fmi3EnterContinuousTimeMode) FINE(fmi3SetTime)
int fmi2ExitInitializationMode(C c) { return leave(c); }
int fmi3ExitInitializationMode(C c) { return leave(c); }
int fmi2GetReal(C c, const VR *v, size_t n, double *x) { return get(c, v, n, x); }
int fmi3GetFloat64(C c, const VR *v, size_t n, double *x, size_t k) { return get(c, v, n, x); }
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((M *)c)->real[v[n]] = x[n]; return 0; }
int fmi3SetFloat64(C c, const VR *v, size_t n, const double *x, size_t k) { return fmi2SetReal(c, v, n, x); }
int fmi2DoStep(C c, double t, double h, int no) { return step(c, h); }
int fmi3DoStep(C c, double t, double h, _Bool no, _Bool *event, _Bool *end, _Bool *early, double *last) {
    *event = *end = *early = 0;
    *last = t + h;
    return step(c, h);
}
int fmi2NewDiscreteStates(C c, EventInfo *e) { memset(e, 0, sizeof *e); return 0; }
int fmi3UpdateDiscreteStates(C c, _Bool *more, _Bool *end, _Bool *nominals, _Bool *states, _Bool *defined, double *t) {
    *more = *end = *nominals = *states = *defined = 0;
    return 0;
}
int fmi2CompletedIntegratorStep(C c, int no, int *event, int *end) { *event = *end = 0; return 0; }
int fmi3CompletedIntegratorStep(C c, _Bool no, _Bool *event, _Bool *end) { *event = *end = 0; return 0; }
int fmi2SetContinuousStates(C c, const double *x, size_t n) { memcpy(((M *)c)->real + X, x, n * 8); return 0; }
int fmi3SetContinuousStates(C c, const double *x, size_t n) { return fmi2SetContinuousStates(c, x, n); }
int fmi2GetContinuousStates(C c, double *x, size_t n) { memcpy(x, ((M *)c)->real + X, n * 8); return 0; }
int fmi3GetContinuousStates(C c, double *x, size_t n) { return fmi2GetContinuousStates(c, x, n); }
int fmi2GetDerivatives(C c, double *x, size_t n) { slopes(c); memcpy(x, ((M *)c)->real + DER_X, n * 8); return 0; }
int fmi3GetContinuousStateDerivatives(C c, double *x, size_t n) { return fmi2GetDerivatives(c, x, n); }
int fmi2GetEventIndicators(C c, double *x, size_t n) { return 0; }
int fmi3GetEventIndicators(C c, double *x, size_t n) { return 0; }
int fmi2GetNominalsOfContinuousStates(C c, double *x, size_t n) { while (n--) x[n] = 1; return 0; }
int fmi3GetNominalsOfContinuousStates(C c, double *x, size_t n) { return fmi2GetNominalsOfContinuousStates(c, x, n); }
int fmi3GetNumberOfEventIndicators(C c, size_t *n) { *n = 0; return 0; }
int fmi3GetNumberOfContinuousStates(C c, size_t *n) { *n = 2; return 0; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi3GetVersion(void) { return "3.0"; }
#define NONE(name) int name(void) { return 3; }
NONE(fmi2GetInteger) NONE(fmi2GetBoolean) NONE(fmi2GetString) NONE(fmi2SetInteger) NONE(fmi2SetBoolean)
NONE(fmi2SetString) NONE(fmi2GetFMUstate) NONE(fmi2SetFMUstate) NONE(fmi2FreeFMUstate)
NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate) NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative) NONE(fmi2SetRealInputDerivatives) NONE(fmi2GetRealOutputDerivatives)
NONE(fmi2CancelStep) NONE(fmi2GetStatus) NONE(fmi2GetRealStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus) NONE(fmi3InstantiateScheduledExecution) NONE(fmi3GetFloat32) NONE(fmi3SetFloat32)
NONE(fmi3GetInt8) NONE(fmi3GetInt16) NONE(fmi3GetUInt16) NONE(fmi3GetInt32) NONE(fmi3GetUInt32) NONE(fmi3GetInt64)
NONE(fmi3GetUInt8) NONE(fmi3GetUInt64) NONE(fmi3GetBoolean) NONE(fmi3GetString) NONE(fmi3GetBinary) NONE(fmi3GetClock)
NONE(fmi3SetInt8) NONE(fmi3SetInt16) NONE(fmi3SetUInt16) NONE(fmi3SetInt32) NONE(fmi3SetUInt32) NONE(fmi3SetInt64)
NONE(fmi3SetUInt8) NONE(fmi3SetUInt64) NONE(fmi3SetBoolean) NONE(fmi3SetString) NONE(fmi3SetBinary) NONE(fmi3SetClock)
NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetVariableDependencies) NONE(fmi3GetFMUState) NONE(fmi3SetFMUState)
NONE(fmi3FreeFMUState) NONE(fmi3SerializedFMUStateSize) NONE(fmi3SerializeFMUState) NONE(fmi3DeserializeFMUState)
NONE(fmi3GetDirectionalDerivative) NONE(fmi3GetAdjointDerivative) NONE(fmi3EnterConfigurationMode)
NONE(fmi3ExitConfigurationMode) NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction) NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction) NONE(fmi3EvaluateDiscreteStates) NONE(fmi3GetOutputDerivatives) NONE(fmi3ActivateModelPartition)
