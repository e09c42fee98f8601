/* A first-order lag, T·dy/dt = gain·u + bias - y by Euler's rule, for co-simulation by FMI 2.0. */
#include <stdlib.h>
#include <string.h>
typedef void *C; typedef unsigned VR;
enum { U, Y, GAIN, BIAS, T, REALS };
typedef struct { double r[REALS]; int b; } M;
C fmi2Instantiate(const char *n, int t, const char *g, const char *s, const void *f, int v, int l)
{ M *m = calloc(1, sizeof(M)); m->r[GAIN] = m->r[T] = 1; return strcmp(g, "lag") ? 0 : m; }
void fmi2FreeInstance(C c) { free(c); }
int fmi2SetupExperiment(C c, int d, double t, double s, int e, double p) { return 0; }
int fmi2EnterInitializationMode(C c) { return 0; }
int fmi2ExitInitializationMode(C c) { return 0; }
int fmi2Terminate(C c) { return 0; }
int fmi2Reset(C c) { return 0; }
int fmi2SetDebugLogging(C c, int o, size_t n, const char *const k[]) { return 0; }
int fmi2GetReal(C c, const VR *v, size_t n, double *x) { while (n--) x[n] = ((M *)c)->r[v[n]]; return 0; }
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((M *)c)->r[v[n]] = x[n]; return 0; }
int fmi2GetBoolean(C c, const VR *v, size_t n, int *x) { while (n--) x[n] = ((M *)c)->b; return 0; }
int fmi2SetBoolean(C c, const VR *v, size_t n, const int *x) { while (n--) ((M *)c)->b = x[n]; return 0; }
int fmi2GetInteger(C c, const VR *v, size_t n, int *x) { return n ? 3 : 0; }
int fmi2SetInteger(C c, const VR *v, size_t n, const int *x) { return n ? 3 : 0; }
int fmi2GetString(C c, const VR *v, size_t n, const char **x) { return n ? 3 : 0; }
int fmi2SetString(C c, const VR *v, size_t n, const char *const *x) { return n ? 3 : 0; }
int fmi2DoStep(C c, double t, double h, int k)
{ M *m = c; double *r = m->r;
  if (!m->b) r[Y] += h / r[T] * (r[GAIN] * r[U] + r[BIAS] - r[Y]);
  return 0; }
int fmi2GetFMUstate(C c, void **s) { if (!*s) *s = malloc(sizeof(M)); memcpy(*s, c, sizeof(M)); return 0; }
int fmi2SetFMUstate(C c, void *s) { memcpy(c, s, sizeof(M)); return 0; }
int fmi2FreeFMUstate(C c, void **s) { free(*s); *s = 0; return 0; }
int fmi2SerializedFMUstateSize(C c, void *s, size_t *n) { return 3; }
int fmi2SerializeFMUstate(C c, void *s, char *b, size_t n) { return 3; }
int fmi2DeSerializeFMUstate(C c, const char *b, size_t n, void **s) { return 3; }
int fmi2GetDirectionalDerivative(C c, const VR *a, size_t n, const VR *b, size_t m, const double *s, double *x)
{ return 3; }
int fmi2SetRealInputDerivatives(C c, const VR *v, size_t n, const int *o, const double *x) { return 3; }
int fmi2GetRealOutputDerivatives(C c, const VR *v, size_t n, const int *o, double *x) { return 3; }
int fmi2CancelStep(C c) { return 3; }
int fmi2GetStatus(C c, int k, int *x) { return 2; }
int fmi2GetRealStatus(C c, int k, double *x) { return 2; }
int fmi2GetIntegerStatus(C c, int k, int *x) { return 2; }
int fmi2GetBooleanStatus(C c, int k, int *x) { return 2; }
int fmi2GetStringStatus(C c, int k, const char **x) { return 2; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
