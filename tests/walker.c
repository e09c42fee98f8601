/* A walk with a memory for co-simulation of FMI 2.0 and 3.0: a damped oscillator with noise of its own and hidden states.
   Variables: 1 u, 2 y, 3 gain (tunable), 4 pause [us of each step], 5 kicks (local), 6 mood (text of FMI 2.0),
   7 limit [s], beyond which no step goes, 8 bound: 1 for steps up to the end that it was told, which its state holds. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef void *C;
typedef unsigned VR;
typedef struct {
    double u, x, v, gain, pause, kicks, limit, bound, stop, time;
    uint64_t random;
    char mood[32];
} Walk;

static void *begin(void)
{
    Walk *w = calloc(1, sizeof(Walk));
    w->gain = 1.0;
    w->limit = w->stop = 1e30;
    w->random = 88172645463325252u;
    strcpy(w->mood, "calm");
    return w;
}

static double *place(Walk *w, VR r)
{
    double *places[] = {&w->u, &w->x, &w->gain, &w->pause, &w->kicks, &w->kicks, &w->limit, &w->bound};
    return places[(r - 1) % 8];
}

static int step(Walk *w, double t, double h)
{
    if (t + h > w->limit + 1e-9 || (w->bound > 0.5 && t + h > w->stop + 1e-9)) return 3;
    w->random = w->random * 6364136223846793005u + 1442695040888963407u;
    const double kick = (double)(w->random >> 11) / 9007199254740992.0 - 0.5;
    w->v += h * (w->gain * w->u - w->x - 0.1 * w->v + 3.0 * kick);
    w->x += h * w->v;
    w->time = t + h;
    if (kick > 0.45) {
        w->kicks += 1.0;
        snprintf(w->mood, sizeof w->mood, "kick \"%d\", é", (int)w->kicks);
    }
    if (w->pause > 0.0) usleep((useconds_t)w->pause);
    return 0;
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
C fmi2Instantiate(void) { return begin(); }
void fmi2FreeInstance(C c) { free(c); }
int fmi2GetReal(C c, const VR *r, size_t n, double *x) { while (n--) x[n] = *place(c, r[n]); return 0; }
int fmi2SetReal(C c, const VR *r, size_t n, const double *x) { while (n--) *place(c, r[n]) = x[n]; return 0; }
int fmi2GetString(C c, const VR *r, size_t n, const char **x) { (void)r; while (n--) x[n] = ((Walk *)c)->mood; return 0; }
int fmi2DoStep(C c, double t, double h, int no) { (void)no; return step(c, t, h); }
int fmi2SetupExperiment(C c, int is_near, double near, double start, int ends, double stop)
{
    (void)is_near, (void)near, (void)start;
    ((Walk *)c)->stop = ends ? stop : 1e30;
    return 0;
}
int fmi2GetFMUstate(C c, void **s) { if (!*s) *s = malloc(sizeof(Walk)); memcpy(*s, c, sizeof(Walk)); return 0; }
int fmi2SetFMUstate(C c, void *s) { memcpy(c, s, sizeof(Walk)); return 0; }
int fmi2FreeFMUstate(C c, void **s) { (void)c; free(*s); *s = NULL; return 0; }
int fmi2SerializedFMUstateSize(C c, void *s, size_t *n) { (void)c; (void)s; *n = sizeof(Walk); return 0; }
int fmi2SerializeFMUstate(C c, void *s, char *b, size_t n) { (void)c; memcpy(b, s, n); return 0; }
int fmi2DeSerializeFMUstate(C c, const char *b, size_t n, void **s) { (void)c; *s = malloc(n); memcpy(*s, b, n); return 0; }
#define FINE2(name) int fmi2##name(void) { return 0; }
FINE2(SetDebugLogging) FINE2(EnterInitializationMode) FINE2(ExitInitializationMode) FINE2(Terminate)
FINE2(Reset)
#define NONE2(name) int fmi2##name(void) { return 3; }
NONE2(GetInteger) NONE2(GetBoolean) NONE2(SetInteger) NONE2(SetBoolean) NONE2(SetString) NONE2(GetDirectionalDerivative)
NONE2(SetRealInputDerivatives) NONE2(GetRealOutputDerivatives) NONE2(CancelStep) NONE2(GetStatus) NONE2(GetRealStatus)
NONE2(GetIntegerStatus) NONE2(GetBooleanStatus) NONE2(GetStringStatus)

const char *fmi3GetVersion(void) { return "3.0"; }
C fmi3InstantiateCoSimulation(void) { return begin(); }
void fmi3FreeInstance(C c) { free(c); }
int fmi3GetFloat64(C c, const VR *r, size_t n, double *x, size_t k) { (void)k; return fmi2GetReal(c, r, n, x); }
int fmi3SetFloat64(C c, const VR *r, size_t n, const double *x, size_t k) { (void)k; return fmi2SetReal(c, r, n, x); }
int fmi3DoStep(C c, double t, double h, _Bool no, _Bool *event, _Bool *end, _Bool *early, double *last)
{
    (void)no;
    const int status = step(c, t, h);
    *event = *end = *early = 0;
    *last = t + h;
    return status;
}
int fmi3EnterInitializationMode(C c, _Bool is_near, double near, double start, _Bool ends, double stop)
{
    return fmi2SetupExperiment(c, is_near, near, start, ends, stop);
}
int fmi3GetFMUState(C c, void **s) { return fmi2GetFMUstate(c, s); }
int fmi3SetFMUState(C c, void *s) { return fmi2SetFMUstate(c, s); }
int fmi3FreeFMUState(C c, void **s) { return fmi2FreeFMUstate(c, s); }
int fmi3SerializedFMUStateSize(C c, void *s, size_t *n) { return fmi2SerializedFMUstateSize(c, s, n); }
int fmi3SerializeFMUState(C c, void *s, char *b, size_t n) { return fmi2SerializeFMUstate(c, s, b, n); }
int fmi3DeserializeFMUState(C c, const char *b, size_t n, void **s) { return fmi2DeSerializeFMUstate(c, b, n, s); }
#define FINE3(name) int fmi3##name(void) { return 0; }
FINE3(ExitInitializationMode) FINE3(Terminate) FINE3(Reset) FINE3(SetDebugLogging)
FINE3(EnterEventMode) FINE3(EnterStepMode)
#define NONE3(name) int fmi3##name(void) { return 3; }
NONE3(InstantiateModelExchange) NONE3(InstantiateScheduledExecution) NONE3(GetFloat32) NONE3(GetInt8) NONE3(GetUInt8)
NONE3(GetInt16) NONE3(GetUInt16) NONE3(GetInt32) NONE3(GetUInt32) NONE3(GetInt64) NONE3(GetUInt64) NONE3(GetBoolean)
NONE3(GetString) NONE3(GetBinary) NONE3(GetClock) NONE3(SetFloat32) NONE3(SetInt8) NONE3(SetUInt8) NONE3(SetInt16)
NONE3(SetUInt16) NONE3(SetInt32) NONE3(SetUInt32) NONE3(SetInt64) NONE3(SetUInt64) NONE3(SetBoolean) NONE3(SetString)
NONE3(SetBinary) NONE3(SetClock) NONE3(GetNumberOfVariableDependencies) NONE3(GetVariableDependencies)
NONE3(GetDirectionalDerivative) NONE3(GetAdjointDerivative) NONE3(EnterConfigurationMode) NONE3(ExitConfigurationMode)
NONE3(GetIntervalDecimal) NONE3(GetIntervalFraction) NONE3(GetShiftDecimal) NONE3(GetShiftFraction)
NONE3(SetIntervalDecimal) NONE3(SetIntervalFraction) NONE3(SetShiftDecimal) NONE3(SetShiftFraction)
NONE3(EvaluateDiscreteStates) NONE3(UpdateDiscreteStates) NONE3(GetOutputDerivatives) NONE3(ActivateModelPartition)
NONE3(EnterContinuousTimeMode) NONE3(CompletedIntegratorStep) NONE3(SetTime) NONE3(SetContinuousStates)
NONE3(GetContinuousStateDerivatives) NONE3(GetEventIndicators) NONE3(GetContinuousStates)
NONE3(GetNominalsOfContinuousStates) NONE3(GetNumberOfEventIndicators) NONE3(GetNumberOfContinuousStates)
