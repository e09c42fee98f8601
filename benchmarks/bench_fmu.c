/* An FMU for co-simulation (FMI 2.0) of first-order lags, for the benchmark: inputs 0..4, outputs 5..9, parameter 10. */
#include <stdlib.h>
#include <string.h>

typedef void *Component;
typedef struct { double values[11]; } State;

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
int fmi2Reset(Component c) {
    double *v = ((State *)c)->values;
    for (int k = 0; k < 10; k++) v[k] = k < 5 ? 0.0 : 1.0;
    v[10] = 1.1;
    return 0;
}
Component fmi2Instantiate(const char *name, int kind, const char *guid, const char *place, const void *callbacks,
                          int visible, int logging) {
    State *s = calloc(1, sizeof(State));
    if (s) fmi2Reset(s);
    return s;
}
void fmi2FreeInstance(Component c) { free(c); }
int fmi2GetReal(Component c, const unsigned r[], size_t n, double v[]) {
    for (size_t k = 0; k < n; k++) v[k] = ((State *)c)->values[r[k] % 11];
    return 0;
}
int fmi2SetReal(Component c, const unsigned r[], size_t n, const double v[]) {
    for (size_t k = 0; k < n; k++) ((State *)c)->values[r[k] % 11] = v[k];
    return 0;
}
int fmi2DoStep(Component c, double t, double h, int no) {
    double *v = ((State *)c)->values;
    for (int k = 0; k < 5; k++) v[k + 5] += h * (v[k] - v[10] * v[k + 5]);
    return 0;
}

#define REST(name, ...) int name(__VA_ARGS__) { return 0; }
REST(fmi2SetDebugLogging, Component c, int on, size_t n, const char *const *categories)
REST(fmi2SetupExperiment, Component c, int d, double t, double s, int e, double x)
REST(fmi2EnterInitializationMode, Component c)
REST(fmi2ExitInitializationMode, Component c)
REST(fmi2Terminate, Component c)
REST(fmi2GetInteger, Component c, const unsigned r[], size_t n, int v[])
REST(fmi2GetBoolean, Component c, const unsigned r[], size_t n, int v[])
REST(fmi2GetString, Component c, const unsigned r[], size_t n, const char *v[])
REST(fmi2SetInteger, Component c, const unsigned r[], size_t n, const int v[])
REST(fmi2SetBoolean, Component c, const unsigned r[], size_t n, const int v[])
REST(fmi2SetString, Component c, const unsigned r[], size_t n, const char *const v[])
REST(fmi2GetFMUstate, Component c, void **s)
REST(fmi2SetFMUstate, Component c, void *s)
REST(fmi2FreeFMUstate, Component c, void **s)
REST(fmi2SerializedFMUstateSize, Component c, void *s, size_t *n)
REST(fmi2SerializeFMUstate, Component c, void *s, char b[], size_t n)
REST(fmi2DeSerializeFMUstate, Component c, const char b[], size_t n, void **s)
REST(fmi2GetDirectionalDerivative, Component c, const unsigned u[], size_t n, const unsigned k[], size_t m,
     const double d[], double v[])
REST(fmi2SetRealInputDerivatives, Component c, const unsigned r[], size_t n, const int o[], const double v[])
REST(fmi2GetRealOutputDerivatives, Component c, const unsigned r[], size_t n, const int o[], double v[])
REST(fmi2CancelStep, Component c)
REST(fmi2GetStatus, Component c, int k, int *v)
REST(fmi2GetRealStatus, Component c, int k, double *v)
REST(fmi2GetIntegerStatus, Component c, int k, int *v)
REST(fmi2GetBooleanStatus, Component c, int k, int *v)
REST(fmi2GetStringStatus, Component c, int k, const char **v)

#ifdef WITH_VARIABLE
int instances_so_far = 0; /* instances of a library with such a variable may depend on each other */
#endif
