/* A node of a bus: it sends two bytes each 0.3 s and counts what arrives; clocked values only at their ticks. Where it
 * logs, it says 300 lines a step. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
typedef void (*Log)(void *, int, const char *, const char *);
enum { OK, WARNING, DISCARD, ERROR };
#define FINE(name) int name() { return OK; }
#define NONE(name) int name() { return ERROR; }

typedef struct { int receives, sends, evaluated, sent, arrived; double next; uint8_t raw[9]; size_t size; uint8_t out[2]; Log log; C at; } M;
enum { RX = 1, TX, RX_CLOCK, TX_CLOCK, ARRIVED, BYTES };
C fmi3InstantiateCoSimulation(const char *name, const char *token, const char *place, _Bool visible, _Bool logging,
                              _Bool events, _Bool early, const VR *v, size_t n, void *at, Log log, void *update) {
    M *m = calloc(1, sizeof(M));
    m->sends = 1; m->next = 0.3; m->log = logging ? log : NULL; m->at = at;
    return m;
}
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
    char line[50];
    for (int k = 0; m->log && k < 300; k++) { snprintf(line, sizeof line, "%d at %g", k, t); m->log(m->at, OK, "all", line); }
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
