/* x' = u + w, y = x + u + w, for co-simulation and model exchange of FMI 2.0. Variables: 0 u, 1 x, 2 y, 3 der(x), 4 n (integer
   input), 5 m = n (integer output), 6 w. */
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned VR;
typedef struct { double u, w, x, time; int n; } Follow;
typedef struct { int newNeeded, terminate, nominals, values, hasNext; double next; } Events;

static double value(const Follow *f, VR r)
{
    switch (r) {
    case 0: return f->u;
    case 1: return f->x;
    case 3: return f->u + f->w;
    case 6: return f->w;
    default: return f->x + f->u + f->w;
    }
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
C fmi2Instantiate(void) { return calloc(1, sizeof(Follow)); }
void fmi2FreeInstance(C c) { free(c); }
int fmi2GetReal(C c, const VR *r, size_t n, double *v) { while (n--) v[n] = value(c, r[n]); return 0; }
int fmi2SetReal(C c, const VR *r, size_t n, const double *v)
{
    while (n--)
        if (r[n] == 0) ((Follow *)c)->u = v[n];
        else if (r[n] == 1) ((Follow *)c)->x = v[n];
        else if (r[n] == 6) ((Follow *)c)->w = v[n];
        else return 3;
    return 0;
}
int fmi2GetInteger(C c, const VR *r, size_t n, int *v) { (void)r; while (n--) v[n] = ((Follow *)c)->n; return 0; }
int fmi2SetInteger(C c, const VR *r, size_t n, const int *v) { (void)r; while (n--) ((Follow *)c)->n = v[n]; return 0; }
int fmi2DoStep(C c, double t, double h, int no)
{
    Follow *f = c;
    (void)no;
    f->x += h * (f->u + f->w);
    f->time = t + h;
    return 0;
}
int fmi2SetTime(C c, double t) { ((Follow *)c)->time = t; return 0; }
int fmi2SetContinuousStates(C c, const double *x, size_t n) { if (n) ((Follow *)c)->x = *x; return 0; }
int fmi2GetContinuousStates(C c, double *x, size_t n) { if (n) *x = ((Follow *)c)->x; return 0; }
int fmi2GetDerivatives(C c, double *d, size_t n) { if (n) *d = value(c, 3); return 0; }
int fmi2GetEventIndicators(C c, double *z, size_t n) { (void)c; (void)z; (void)n; return 0; }
int fmi2GetNominalsOfContinuousStates(C c, double *x, size_t n) { (void)c; if (n) *x = 1.0; return 0; }
int fmi2NewDiscreteStates(C c, Events *e) { (void)c; memset(e, 0, sizeof *e); return 0; }
int fmi2CompletedIntegratorStep(C c, int no, int *event, int *end) { (void)c; (void)no; *event = *end = 0; return 0; }
int fmi2GetFMUstate(C c, void **s) { if (!*s) *s = malloc(sizeof(Follow)); memcpy(*s, c, sizeof(Follow)); return 0; }
int fmi2SetFMUstate(C c, void *s) { memcpy(c, s, sizeof(Follow)); return 0; }
int fmi2FreeFMUstate(C c, void **s) { (void)c; free(*s); *s = NULL; return 0; }
int fmi2SerializedFMUstateSize(C c, void *s, size_t *n) { (void)c; (void)s; *n = sizeof(Follow); return 0; }
int fmi2SerializeFMUstate(C c, void *s, char *b, size_t n) { (void)c; memcpy(b, s, n); return 0; }
int fmi2DeSerializeFMUstate(C c, const char *b, size_t n, void **s) { (void)c; *s = malloc(n); memcpy(*s, b, n); return 0; }
#define FINE(name) int fmi2##name(void) { return 0; }
FINE(SetDebugLogging) FINE(SetupExperiment) FINE(EnterInitializationMode) FINE(ExitInitializationMode) FINE(Terminate)
FINE(Reset) FINE(EnterEventMode) FINE(EnterContinuousTimeMode)
#define NONE(name) int fmi2##name(void) { return 3; }
NONE(GetBoolean) NONE(GetString) NONE(SetBoolean) NONE(SetString) NONE(GetDirectionalDerivative)
NONE(SetRealInputDerivatives) NONE(GetRealOutputDerivatives) NONE(CancelStep) NONE(GetStatus) NONE(GetRealStatus)
NONE(GetIntegerStatus) NONE(GetBooleanStatus) NONE(GetStringStatus)
