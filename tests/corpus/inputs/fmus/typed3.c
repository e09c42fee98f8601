/* FMI 3.0 co-simulation: 64-bit integers, bytes, arrays, text and binary data passed through. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef uint32_t VR;
typedef struct { double array[2][4]; int64_t whole[2]; uint8_t byte[2]; char text[2][200]; uint8_t raw[2][16]; size_t size[2]; float single; } M;

const char *fmi3GetVersion(void) { return "3.0"; }
C fmi3InstantiateCoSimulation(void) { return calloc(1, sizeof(M)); }
void fmi3FreeInstance(C c) { free(c); }
#define FINE(name) int name(void) { return 0; }
FINE(fmi3EnterInitializationMode) FINE(fmi3ExitInitializationMode) FINE(fmi3Terminate) FINE(fmi3Reset)
FINE(fmi3SetDebugLogging) FINE(fmi3EnterEventMode) FINE(fmi3EnterStepMode)
int fmi3GetFloat64(C c, const VR *v, size_t n, double *x, size_t k) {
    M *m = c;
    size_t size = n ? k / n : 0;
    for (size_t i = 0; i < n; i++) memcpy(x + i * size, m->array[v[i] - 1], size * 8);
    return 0;
}
int fmi3SetFloat64(C c, const VR *v, size_t n, const double *x, size_t k) {
    M *m = c;
    size_t size = n ? k / n : 0;
    for (size_t i = 0; i < n; i++) memcpy(m->array[v[i] - 1], x + i * size, size * 8);
    return 0;
}
int fmi3GetFloat32(C c, const VR *v, size_t n, float *x, size_t k) {
    const float f = ((M *)c)->single;
    (void)k;
    while (n--) x[n] = v[n] == 11 ? f : f * f;
    return 0;
}
int fmi3SetFloat32(C c, const VR *v, size_t n, const float *x, size_t k) { (void)v; (void)k; while (n--) ((M *)c)->single = x[n]; return 0; }
int fmi3GetInt64(C c, const VR *v, size_t n, int64_t *x, size_t k) { (void)k; while (n--) x[n] = ((M *)c)->whole[v[n] - 3]; return 0; }
int fmi3SetInt64(C c, const VR *v, size_t n, const int64_t *x, size_t k) { (void)k; while (n--) ((M *)c)->whole[v[n] - 3] = x[n]; return 0; }
int fmi3GetUInt8(C c, const VR *v, size_t n, uint8_t *x, size_t k) { (void)k; while (n--) x[n] = ((M *)c)->byte[v[n] - 5]; return 0; }
int fmi3SetUInt8(C c, const VR *v, size_t n, const uint8_t *x, size_t k) { (void)k; while (n--) ((M *)c)->byte[v[n] - 5] = x[n]; return 0; }
int fmi3GetString(C c, const VR *v, size_t n, const char **x, size_t k) { (void)k; while (n--) x[n] = ((M *)c)->text[v[n] - 7]; return 0; }
int fmi3SetString(C c, const VR *v, size_t n, const char *const *x, size_t k) { (void)k; while (n--) strncpy(((M *)c)->text[v[n] - 7], x[n], 199); return 0; }
int fmi3GetBinary(C c, const VR *v, size_t n, size_t *s, const uint8_t **x, size_t k) {
    (void)k;
    while (n--) { s[n] = ((M *)c)->size[v[n] - 9]; x[n] = s[n] ? ((M *)c)->raw[v[n] - 9] : 0; }
    return 0;
}
int fmi3SetBinary(C c, const VR *v, size_t n, const size_t *s, const uint8_t *const *x, size_t k) {
    (void)k;
    while (n--) { ((M *)c)->size[v[n] - 9] = s[n]; memcpy(((M *)c)->raw[v[n] - 9], x[n], s[n]); }
    return 0;
}
int fmi3DoStep(C c, double t, double h, _Bool no, _Bool *event, _Bool *end, _Bool *early, double *last) {
    M *m = c;
    (void)no;
    for (int i = 0; i < 4; i++) m->array[1][i] = 2 * m->array[0][i];
    m->whole[1] = m->whole[0] + 1;
    m->byte[1] = m->byte[0];
    memcpy(m->text[1], m->text[0], 200);
    memcpy(m->raw[1], m->raw[0], 16);
    m->size[1] = m->size[0];
    *event = 0;
    *end = m->byte[0] == 250 || m->byte[0] == 251; /* the end is asked for, by 251 before the step's own */
    *early = m->byte[0] == 251;
    *last = *early ? t + 0.5 * h : t + h;
    return 0;
}
#define NONE(name) int name(void) { return 3; }
NONE(fmi3InstantiateModelExchange) NONE(fmi3InstantiateScheduledExecution)
NONE(fmi3GetInt8) NONE(fmi3GetInt16) NONE(fmi3GetUInt16) NONE(fmi3GetInt32) NONE(fmi3GetUInt32)
NONE(fmi3GetUInt64) NONE(fmi3GetBoolean) NONE(fmi3GetClock)
NONE(fmi3SetInt8) NONE(fmi3SetInt16) NONE(fmi3SetUInt16) NONE(fmi3SetInt32) NONE(fmi3SetUInt32)
NONE(fmi3SetUInt64) NONE(fmi3SetBoolean) NONE(fmi3SetClock)
NONE(fmi3GetNumberOfVariableDependencies) NONE(fmi3GetVariableDependencies) NONE(fmi3GetFMUState) NONE(fmi3SetFMUState)
NONE(fmi3FreeFMUState) NONE(fmi3SerializedFMUStateSize) NONE(fmi3SerializeFMUState) NONE(fmi3DeserializeFMUState)
NONE(fmi3GetDirectionalDerivative) NONE(fmi3GetAdjointDerivative) NONE(fmi3EnterConfigurationMode)
NONE(fmi3ExitConfigurationMode) NONE(fmi3GetIntervalDecimal) NONE(fmi3GetIntervalFraction) NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction) NONE(fmi3SetIntervalDecimal) NONE(fmi3SetIntervalFraction) NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction) NONE(fmi3EvaluateDiscreteStates) NONE(fmi3UpdateDiscreteStates)
NONE(fmi3GetOutputDerivatives) NONE(fmi3ActivateModelPartition)
NONE(fmi3EnterContinuousTimeMode) NONE(fmi3CompletedIntegratorStep) NONE(fmi3SetTime) NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives) NONE(fmi3GetEventIndicators) NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates) NONE(fmi3GetNumberOfEventIndicators) NONE(fmi3GetNumberOfContinuousStates)
