/* An FMU for co-simulation (FMI 2.0): y = amplified(u). Where the function comes from is left to the build. */
#include <stdlib.h>

#ifdef __cplusplus
#define API extern "C"
#else
#define API
#endif
typedef void *Component;
typedef struct { double u, y; } State;

#if defined INLINE_GAIN /* a variable of C++ that exists once in a process */
static double amplified(double u) { return held<double>() * u; }
#elif defined OWN_NAME /* a function of a second file */
double amplified(double) __asm__(OWN_NAME);
#else /* a function of a library that the FMU brings */
API double amplified(double);
#endif

API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }
API Component fmi2Instantiate(const char *n, int k, const char *g, const char *r, const void *f, int v, int l) {
    State *s = (State *)calloc(1, sizeof(State));
    s->u = 1.0;
    return s;
}
API void fmi2FreeInstance(Component c) { free(c); }
API int fmi2SetReal(Component c, const unsigned r[], size_t n, const double v[]) {
    for (size_t k = 0; k < n; k++) ((State *)c)->u = v[k];
    return 0;
}
API int fmi2GetReal(Component c, const unsigned r[], size_t n, double v[]) {
    for (size_t k = 0; k < n; k++) v[k] = r[k] ? amplified(((State *)c)->u) : ((State *)c)->u;
    return 0;
}
API int fmi2DoStep(Component c, double t, double h, int no) { return 0; }
#define REST(status, name, ...) API int name(__VA_ARGS__) { return status; }
REST(0, fmi2SetDebugLogging, Component c, int on, size_t n, const char *const *s)
REST(0, fmi2SetupExperiment, Component c, int d, double t, double s, int e, double x)
REST(0, fmi2EnterInitializationMode, Component c)
REST(0, fmi2ExitInitializationMode, Component c)
REST(0, fmi2Terminate, Component c)
REST(0, fmi2Reset, Component c)
REST(3, fmi2GetInteger, Component c, const unsigned r[], size_t n, int v[])
REST(3, fmi2GetBoolean, Component c, const unsigned r[], size_t n, int v[])
REST(3, fmi2GetString, Component c, const unsigned r[], size_t n, const char *v[])
REST(3, fmi2SetInteger, Component c, const unsigned r[], size_t n, const int v[])
REST(3, fmi2SetBoolean, Component c, const unsigned r[], size_t n, const int v[])
REST(3, fmi2SetString, Component c, const unsigned r[], size_t n, const char *const v[])
REST(3, fmi2GetFMUstate, Component c, void **s)
REST(3, fmi2SetFMUstate, Component c, void *s)
REST(3, fmi2FreeFMUstate, Component c, void **s)
REST(3, fmi2SerializedFMUstateSize, Component c, void *s, size_t *n)
REST(3, fmi2SerializeFMUstate, Component c, void *s, char b[], size_t n)
REST(3, fmi2DeSerializeFMUstate, Component c, const char b[], size_t n, void **s)
REST(3, fmi2GetDirectionalDerivative, Component c, const unsigned u[], size_t n, const unsigned k[], size_t m,
     const double d[], double v[])
REST(3, fmi2SetRealInputDerivatives, Component c, const unsigned r[], size_t n, const int o[], const double v[])
REST(3, fmi2GetRealOutputDerivatives, Component c, const unsigned r[], size_t n, const int o[], double v[])
REST(3, fmi2CancelStep, Component c)
REST(3, fmi2GetStatus, Component c, int k, int *v)
REST(3, fmi2GetRealStatus, Component c, int k, double *v)
REST(3, fmi2GetIntegerStatus, Component c, int k, int *v)
REST(3, fmi2GetBooleanStatus, Component c, int k, int *v)
REST(3, fmi2GetStringStatus, Component c, int k, const char **v)
