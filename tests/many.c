/* FMI 2.0 for co-simulation: as many inputs as outputs, each output its input plus the time. */
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
enum { MANY = 20000 };

C fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int v, int l) {
    (void)n; (void)t; (void)g; (void)r; (void)f; (void)v; (void)l;
    return calloc(2 * MANY, sizeof(double));
}
void fmi2FreeInstance(C c) { free(c); }
int fmi2SetupExperiment(C c, int d, double t, double s, int e, double stop) {
    (void)c; (void)d; (void)t; (void)s; (void)e; (void)stop;
    return 0;
}
int fmi2EnterInitializationMode(C c) { (void)c; return 0; }
int fmi2ExitInitializationMode(C c) { (void)c; return 0; }
int fmi2Terminate(C c) { (void)c; return 0; }
int fmi2GetReal(C c, const VR *v, size_t n, double *x) { while (n--) x[n] = ((double *)c)[v[n]]; return 0; }
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((double *)c)[v[n]] = x[n]; return 0; }
#define NONE(NAME) int fmi2##NAME(void) { return 3; } /* has to be there */
NONE(GetInteger) NONE(SetInteger) NONE(GetBoolean) NONE(SetBoolean) NONE(GetString) NONE(SetString)
NONE(SetRealInputDerivatives) NONE(GetRealOutputDerivatives) NONE(CancelStep) NONE(SetDebugLogging)
NONE(GetStatus) NONE(GetRealStatus) NONE(GetIntegerStatus) NONE(GetBooleanStatus) NONE(GetStringStatus)
NONE(GetFMUstate) NONE(SetFMUstate) NONE(FreeFMUstate) NONE(SerializedFMUstateSize) NONE(SerializeFMUstate)
NONE(DeSerializeFMUstate) NONE(GetDirectionalDerivative)
int fmi2Reset(C c) { memset(c, 0, 2 * MANY * sizeof(double)); return 0; }
int fmi2DoStep(C c, double t, double h, int no) {
    double *x = c;
    (void)no;
    for (int k = 0; k < MANY; k++) x[MANY + k] = x[k] + t + h;
    return 0;
}
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
