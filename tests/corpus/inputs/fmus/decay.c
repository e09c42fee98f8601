/* FMI 2.0 model exchange: x' = −x + u from 1; from AT on it does what `deed` says. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
typedef struct { int more, end, nominals, states, defined; double time; } EventInfo;
enum { OK, WARNING, DISCARD, ERROR };
enum { NOTHING, ERROR_OF_STEP, ERROR_OF_UPDATE, ERROR_OF_DERIVATIVE, DISCARDED, NO_NUMBER, CHATTERS, DUE_AT_ONCE,
       ALWAYS_DUE, NO_BOUND };
enum { X, DER, U, Y, DEED, EVENTS, REALS };
#define AT 0.45

typedef struct { double real[REALS], time, rate; int updates; } M;

static int does(M *m, int deed) { return (int)m->real[DEED] == deed && m->time > AT; }
C fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int v, int l) {
    M *m = calloc(1, sizeof(M));
    m->real[X] = 1; m->rate = -1;
    return m;
}
void fmi2FreeInstance(C c) { free(c); }
int fmi2SetupExperiment(C c, int d, double t, double s, int e, double stop) { ((M *)c)->time = s; return OK; }
int fmi2EnterInitializationMode(C c) { return OK; }
int fmi2ExitInitializationMode(C c) { return OK; }
int fmi2Terminate(C c) { return OK; }
int fmi2Reset(C c) { return OK; }
static void evaluate(M *m) {
    double x = m->real[X];
    m->real[DER] = (int)m->real[DEED] == NO_BOUND ? 4 * x * x : m->rate * x + m->real[U];
    if (does(m, NO_NUMBER)) m->real[DER] = NAN;
    m->real[Y] = x;
}
int fmi2GetReal(C c, const VR *v, size_t n, double *x) {
    evaluate(c);
    while (n--) x[n] = ((M *)c)->real[v[n]];
    return OK;
}
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((M *)c)->real[v[n]] = x[n]; return OK; }
int fmi2EnterEventMode(C c) { return OK; }
int fmi2NewDiscreteStates(C c, EventInfo *e) {
    M *m = c;
    memset(e, 0, sizeof *e);
    m->real[EVENTS] = ++m->updates;
    if ((int)m->real[DEED] == ERROR_OF_UPDATE) { e->defined = 1; e->time = m->time < 0.5 ? 0.5 : 2; }
    if (does(m, ERROR_OF_UPDATE)) return ERROR;
    if ((int)m->real[DEED] == CHATTERS) m->rate = m->real[X] <= 0.8 ? 1 : -1;
    if ((int)m->real[DEED] == DUE_AT_ONCE) { e->defined = 1; e->time = m->updates == 1 ? m->time : 0.15; }
    if ((int)m->real[DEED] == DUE_AT_ONCE && m->updates > 2) e->defined = 0;
    if ((int)m->real[DEED] == ALWAYS_DUE) { e->defined = 1; e->time = m->time - 1; }
    return OK;
}
int fmi2EnterContinuousTimeMode(C c) { return OK; }
int fmi2CompletedIntegratorStep(C c, int no, int *event, int *end) {
    *event = *end = 0;
    return does(c, ERROR_OF_STEP) ? ERROR : OK;
}
int fmi2SetTime(C c, double t) { ((M *)c)->time = t; return OK; }
int fmi2SetContinuousStates(C c, const double *x, size_t n) { ((M *)c)->real[X] = x[0]; return OK; }
int fmi2GetContinuousStates(C c, double *x, size_t n) { x[0] = ((M *)c)->real[X]; return OK; }
int fmi2GetDerivatives(C c, double *x, size_t n) {
    evaluate(c);
    x[0] = ((M *)c)->real[DER];
    return does(c, ERROR_OF_DERIVATIVE) ? ERROR : does(c, DISCARDED) ? DISCARD : OK;
}
int fmi2GetEventIndicators(C c, double *z, size_t n) { z[0] = ((M *)c)->real[X] - 0.8; return OK; }
int fmi2GetNominalsOfContinuousStates(C c, double *x, size_t n) { x[0] = 1; return OK; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
#define NONE(name) int name(C c) { return ERROR; }
NONE(fmi2SetDebugLogging) NONE(fmi2GetInteger) NONE(fmi2GetBoolean) NONE(fmi2GetString) NONE(fmi2SetInteger)
NONE(fmi2SetBoolean) NONE(fmi2SetString) NONE(fmi2GetFMUstate) NONE(fmi2SetFMUstate) NONE(fmi2FreeFMUstate)
NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate) NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative)
