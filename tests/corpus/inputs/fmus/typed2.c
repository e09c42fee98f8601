/* FMI 2.0, co-simulation and model exchange: passes every type through; a ball bounces in model exchange. */
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
typedef void (*Logger)(C, const char *, int, const char *, const char *, ...);
typedef struct { Logger logger; void *allocate, *release, *finished; C environment; } Callbacks;
typedef struct { int more, end, nominals, states, defined; double time; } EventInfo;
enum { OK, WARNING, DISCARD, ERROR };
enum { R_IN, R_OUT, LATE, TOLERANCE, GAIN, H, V, DER_H, DER_V, WARN_AT, END_AT, REALS };

typedef struct {
    double real[REALS], time, last;
    int integer[4], boolean[2], event, bounced;
    char text[2][200];
    const Callbacks *callbacks;
} M;

C fmi2Instantiate(const char *n, int t, const char *g, const char *r, const Callbacks *f, int v, int l) {
    M *m = calloc(1, sizeof(M));
    (void)n; (void)t; (void)g; (void)r; (void)v;
    m->callbacks = f;
    m->real[GAIN] = 1; m->real[H] = 1; m->real[WARN_AT] = m->real[END_AT] = 1e9; m->real[TOLERANCE] = -1;
    m->integer[2] = m->integer[3] = 1;
    if (l) f->logger(f->environment, "x", OK, "logAll", "debugging");
    return m;
}
void fmi2FreeInstance(C c) { free(c); }
int fmi2SetupExperiment(C c, int d, double t, double s, int e, double stop) {
    M *m = c;
    (void)e; (void)stop;
    if (d) m->real[TOLERANCE] = t;
    m->time = s;
    return OK;
}
int fmi2EnterInitializationMode(C c) { (void)c; return OK; }
int fmi2ExitInitializationMode(C c) { ((M *)c)->real[LATE] = 7; return OK; }
int fmi2Terminate(C c) { (void)c; return OK; }
int fmi2Reset(C c) { (void)c; return OK; }
static void pass(M *m) {
    m->real[R_OUT] = m->real[GAIN] * m->real[R_IN];
    m->integer[1] = m->integer[0]; m->integer[3] = m->integer[2];
    m->boolean[1] = m->boolean[0];
    strcpy(m->text[1], m->text[0]);
    m->real[DER_H] = m->real[V]; m->real[DER_V] = -9.81 + m->real[R_IN];
}
int fmi2GetReal(C c, const VR *v, size_t n, double *x) { pass(c); while (n--) x[n] = ((M *)c)->real[v[n]]; return OK; }
int fmi2GetInteger(C c, const VR *v, size_t n, int *x) { pass(c); while (n--) x[n] = ((M *)c)->integer[v[n]]; return OK; }
int fmi2GetBoolean(C c, const VR *v, size_t n, int *x) { pass(c); while (n--) x[n] = ((M *)c)->boolean[v[n]]; return OK; }
int fmi2GetString(C c, const VR *v, size_t n, const char **x) { pass(c); while (n--) x[n] = ((M *)c)->text[v[n]]; return OK; }
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((M *)c)->real[v[n]] = x[n]; return OK; }
int fmi2SetInteger(C c, const VR *v, size_t n, const int *x) { while (n--) ((M *)c)->integer[v[n]] = x[n]; return OK; }
int fmi2SetBoolean(C c, const VR *v, size_t n, const int *x) { while (n--) ((M *)c)->boolean[v[n]] = x[n]; return OK; }
int fmi2SetString(C c, const VR *v, size_t n, const char *const *x) {
    while (n--) strncpy(((M *)c)->text[v[n]], x[n], 199);
    return OK;
}
int fmi2DoStep(C c, double t, double h, int no) {
    M *m = c;
    (void)no;
    if (t + h > m->real[END_AT] + 1e-9) { m->last = m->real[END_AT]; return DISCARD; }
    m->time = t + h;
    if (m->time < m->real[WARN_AT]) return OK;
    m->callbacks->logger(m->callbacks->environment, "x", WARNING, "logStatusWarning", "it runs %s", "hot");
    return WARNING;
}
int fmi2GetBooleanStatus(C c, int k, int *x) { (void)c; (void)k; *x = 1; return OK; }
int fmi2GetRealStatus(C c, int k, double *x) { (void)k; *x = ((M *)c)->last; return OK; }
/* model exchange */
int fmi2EnterEventMode(C c) { ((M *)c)->event = 1; return OK; }
int fmi2NewDiscreteStates(C c, EventInfo *e) {
    M *m = c;
    memset(e, 0, sizeof *e);
    if (m->real[H] <= 0 && m->real[V] < 0) { m->real[H] = 0; m->real[V] *= -0.7; e->states = 1; m->integer[1]++; }
    return OK;
}
int fmi2EnterContinuousTimeMode(C c) { ((M *)c)->event = 0; return OK; }
int fmi2CompletedIntegratorStep(C c, int no, int *event, int *end) { (void)c; (void)no; *event = *end = 0; return OK; }
int fmi2SetTime(C c, double t) { ((M *)c)->time = t; return OK; }
int fmi2SetContinuousStates(C c, const double *x, size_t n) { memcpy(((M *)c)->real + H, x, n * 8); return OK; }
int fmi2GetContinuousStates(C c, double *x, size_t n) { memcpy(x, ((M *)c)->real + H, n * 8); return OK; }
int fmi2GetDerivatives(C c, double *x, size_t n) { pass(c); memcpy(x, ((M *)c)->real + DER_H, n * 8); return OK; }
int fmi2GetEventIndicators(C c, double *x, size_t n) { (void)n; x[0] = ((M *)c)->real[H]; return OK; }
int fmi2GetNominalsOfContinuousStates(C c, double *x, size_t n) { (void)c; while (n--) x[n] = 0; return OK; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
int fmi2SetDebugLogging(C c, int on, size_t n, const char *const *x) { (void)c; (void)on; (void)n; (void)x; return OK; }
#define NONE(name) int name(C c) { (void)c; return ERROR; }
NONE(fmi2GetFMUstate) NONE(fmi2SetFMUstate) NONE(fmi2FreeFMUstate) NONE(fmi2SerializedFMUstateSize)
NONE(fmi2SerializeFMUstate) NONE(fmi2DeSerializeFMUstate) NONE(fmi2GetDirectionalDerivative)
NONE(fmi2SetRealInputDerivatives) NONE(fmi2GetRealOutputDerivatives) NONE(fmi2CancelStep) NONE(fmi2GetStatus)
NONE(fmi2GetIntegerStatus) NONE(fmi2GetStringStatus)
