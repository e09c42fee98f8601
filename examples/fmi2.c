/* FMI 2.0 around the equations of an example, for model exchange and co-simulation; their file includes this one.
 *
 * Before, it defines
 *   enum { …, REALS }            value references: states, their derivatives in the same order, then all others
 *   STATES                       number of states
 *   INNER                        largest Runge-Kutta step of co-simulation [s]
 *   START[REALS]                 start values
 *   equations(double *v)         writes derivatives and outputs that are no states
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include "fmi2Functions.h"

typedef fmi2Component C;
typedef fmi2Status S;
typedef fmi2ValueReference VR;

static int step(double *v, double h) {
    const int count = (int)fmax(1.0, ceil(h / INNER - 1e-9));
    const double part[] = {0.0, 0.5, 0.5, 1.0}, weight[] = {1.0, 2.0, 2.0, 1.0};
    h /= count;
    for (int k = 0; k < count; k++) {
        double begin[STATES], sum[STATES] = {0}, rate[STATES] = {0};
        memcpy(begin, v, sizeof begin);
        for (int stage = 0; stage < 4; stage++) {
            for (int i = 0; i < STATES; i++) v[i] = begin[i] + part[stage] * h * rate[i];
            equations(v);
            memcpy(rate, v + STATES, sizeof rate);
            for (int i = 0; i < STATES; i++) sum[i] += weight[stage] / 6.0 * h * rate[i];
        }
        for (int i = 0; i < STATES; i++) v[i] = begin[i] + sum[i];
    }
    for (int i = 0; i < STATES; i++)
        if (!isfinite(v[i])) return fmi2Error;
    return fmi2OK;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
S fmi2Reset(C c) { memcpy(c, START, sizeof START); return fmi2OK; }
C fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String place, const fmi2CallbackFunctions *calls,
                  fmi2Boolean visible, fmi2Boolean logs) {
    C c = malloc(sizeof START);
    if (c) fmi2Reset(c);
    return c;
}
void fmi2FreeInstance(C c) { free(c); }
S fmi2SetDebugLogging(C c, fmi2Boolean on, size_t n, const fmi2String *names) { return fmi2OK; }
S fmi2SetupExperiment(C c, fmi2Boolean has, fmi2Real tolerance, fmi2Real t, fmi2Boolean ends, fmi2Real end) { return fmi2OK; }
S fmi2EnterInitializationMode(C c) { return fmi2OK; }
S fmi2ExitInitializationMode(C c) { return fmi2OK; }
S fmi2Terminate(C c) { return fmi2OK; }
S fmi2GetReal(C c, const VR *vr, size_t n, fmi2Real *x) {
    equations(c);
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= REALS) return fmi2Error;
        x[i] = ((double *)c)[vr[i]];
    }
    return fmi2OK;
}
S fmi2SetReal(C c, const VR *vr, size_t n, const fmi2Real *x) {
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= REALS) return fmi2Error;
        ((double *)c)[vr[i]] = x[i];
    }
    return fmi2OK;
}
#define NONE(what, type) \
    S fmi2Get##what(C c, const VR *vr, size_t n, type *x) { return n ? fmi2Error : fmi2OK; } \
    S fmi2Set##what(C c, const VR *vr, size_t n, const type *x) { return n ? fmi2Error : fmi2OK; }
NONE(Integer, fmi2Integer) NONE(Boolean, fmi2Boolean) NONE(String, fmi2String)

S fmi2GetFMUstate(C c, fmi2FMUstate *saved) {
    if (!*saved) *saved = malloc(sizeof START);
    memcpy(*saved, c, sizeof START);
    return fmi2OK;
}
S fmi2SetFMUstate(C c, fmi2FMUstate saved) { memcpy(c, saved, sizeof START); return fmi2OK; }
S fmi2FreeFMUstate(C c, fmi2FMUstate *saved) { free(*saved); *saved = NULL; return fmi2OK; }
S fmi2SerializedFMUstateSize(C c, fmi2FMUstate saved, size_t *n) { return fmi2Error; }
S fmi2SerializeFMUstate(C c, fmi2FMUstate saved, fmi2Byte *to, size_t n) { return fmi2Error; }
S fmi2DeSerializeFMUstate(C c, const fmi2Byte *from, size_t n, fmi2FMUstate *saved) { return fmi2Error; }
S fmi2GetDirectionalDerivative(C c, const VR *z, size_t nz, const VR *x, size_t nx, const fmi2Real *dx, fmi2Real *dz) {
    return fmi2Error;
}

S fmi2EnterEventMode(C c) { return fmi2OK; }
S fmi2NewDiscreteStates(C c, fmi2EventInfo *event) { memset(event, 0, sizeof *event); return fmi2OK; }
S fmi2EnterContinuousTimeMode(C c) { return fmi2OK; }
S fmi2CompletedIntegratorStep(C c, fmi2Boolean no, fmi2Boolean *event, fmi2Boolean *end) {
    *event = *end = fmi2False;
    return fmi2OK;
}
S fmi2SetTime(C c, fmi2Real t) { return fmi2OK; }
S fmi2SetContinuousStates(C c, const fmi2Real *x, size_t n) { memcpy(c, x, n * sizeof *x); return fmi2OK; }
S fmi2GetContinuousStates(C c, fmi2Real *x, size_t n) { memcpy(x, c, n * sizeof *x); return fmi2OK; }
S fmi2GetDerivatives(C c, fmi2Real *dx, size_t n) {
    equations(c);
    memcpy(dx, (double *)c + STATES, n * sizeof *dx);
    return fmi2OK;
}
S fmi2GetEventIndicators(C c, fmi2Real *z, size_t n) { return fmi2OK; }
S fmi2GetNominalsOfContinuousStates(C c, fmi2Real *x, size_t n) { while (n--) x[n] = 1.0; return fmi2OK; }

S fmi2SetRealInputDerivatives(C c, const VR *vr, size_t n, const fmi2Integer *order, const fmi2Real *x) { return fmi2Error; }
S fmi2GetRealOutputDerivatives(C c, const VR *vr, size_t n, const fmi2Integer *order, fmi2Real *x) { return fmi2Error; }
S fmi2DoStep(C c, fmi2Real t, fmi2Real h, fmi2Boolean no) { return step(c, h); }
S fmi2CancelStep(C c) { return fmi2Error; }
#define ASK(what, type) S fmi2Get##what##Status(C c, const fmi2StatusKind kind, type *x) { return fmi2Discard; }
ASK(, fmi2Status) ASK(Real, fmi2Real) ASK(Integer, fmi2Integer) ASK(Boolean, fmi2Boolean) ASK(String, fmi2String)
