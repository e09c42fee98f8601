/* The functions of FMI 3.0 that the FMUs of this example do without: they answer Error. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef void *Instance;
typedef uint32_t Reference;
enum { OK = 0, ERROR = 3, CHANGED = 2, UNCHANGED = 1 };
#define UNUSED(name) int name(void) { return ERROR; }
#define FINE(name) int name(void) { return OK; }

const char *fmi3GetVersion(void) { return "3.0"; }
FINE(fmi3SetDebugLogging) FINE(fmi3Terminate) FINE(fmi3Reset) FINE(fmi3ExitInitializationMode) FINE(fmi3EnterEventMode)
FINE(fmi3EnterStepMode) void fmi3FreeInstance(Instance c) { free(c); }
UNUSED(fmi3InstantiateModelExchange)
UNUSED(fmi3GetFloat32) UNUSED(fmi3SetFloat32) UNUSED(fmi3GetInt8) UNUSED(fmi3SetInt8) UNUSED(fmi3GetInt16)
UNUSED(fmi3SetInt16) UNUSED(fmi3GetInt32) UNUSED(fmi3SetInt32) UNUSED(fmi3GetInt64) UNUSED(fmi3SetInt64)
UNUSED(fmi3GetUInt8) UNUSED(fmi3SetUInt8) UNUSED(fmi3GetUInt16) UNUSED(fmi3SetUInt16) UNUSED(fmi3GetUInt32)
UNUSED(fmi3SetUInt32) UNUSED(fmi3GetUInt64) UNUSED(fmi3SetUInt64) UNUSED(fmi3GetBoolean) UNUSED(fmi3SetBoolean)
UNUSED(fmi3GetString) UNUSED(fmi3SetString) UNUSED(fmi3GetBinary) UNUSED(fmi3SetBinary)
UNUSED(fmi3GetNumberOfVariableDependencies) UNUSED(fmi3GetVariableDependencies) UNUSED(fmi3SerializedFMUStateSize)
UNUSED(fmi3SerializeFMUState) UNUSED(fmi3DeserializeFMUState) UNUSED(fmi3GetDirectionalDerivative)
UNUSED(fmi3GetAdjointDerivative) UNUSED(fmi3EnterConfigurationMode) UNUSED(fmi3ExitConfigurationMode)
UNUSED(fmi3GetIntervalFraction) UNUSED(fmi3GetShiftDecimal) UNUSED(fmi3GetShiftFraction)
UNUSED(fmi3SetIntervalFraction) UNUSED(fmi3SetShiftDecimal) UNUSED(fmi3SetShiftFraction)
UNUSED(fmi3EvaluateDiscreteStates) UNUSED(fmi3GetOutputDerivatives) UNUSED(fmi3EnterContinuousTimeMode)
UNUSED(fmi3CompletedIntegratorStep) UNUSED(fmi3SetTime) UNUSED(fmi3SetContinuousStates)
UNUSED(fmi3GetContinuousStateDerivatives) UNUSED(fmi3GetEventIndicators) UNUSED(fmi3GetContinuousStates)
UNUSED(fmi3GetNominalsOfContinuousStates) UNUSED(fmi3GetNumberOfEventIndicators)
UNUSED(fmi3GetNumberOfContinuousStates)

/* Values are read and written by their value references, which are the places in `real`. */
#define VALUES(TYPE)                                                                                       \
    int fmi3GetFloat64(Instance c, const Reference *v, size_t n, double *x, size_t k)                      \
    { (void)k; while (n--) x[n] = ((TYPE *)c)->real[v[n]]; return OK; }                                    \
    int fmi3SetFloat64(Instance c, const Reference *v, size_t n, const double *x, size_t k)                \
    { (void)k; while (n--) ((TYPE *)c)->real[v[n]] = x[n]; return OK; }
#define STATES(TYPE)                                                                                       \
    int fmi3GetFMUState(Instance c, void **s) { if (!*s) *s = malloc(sizeof(TYPE)); memcpy(*s, c, sizeof(TYPE)); return OK; } \
    int fmi3SetFMUState(Instance c, void *s) { memcpy(c, s, sizeof(TYPE)); return OK; }                     \
    int fmi3FreeFMUState(Instance c, void **s) { (void)c; free(*s); *s = NULL; return OK; }
