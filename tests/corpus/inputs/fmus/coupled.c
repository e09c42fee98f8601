// FMUs of FMI 2.0 with one of several laws, for algebraic loops and step control: y = f(u, x, t), x' = g(u, x, t).
// LAW is defined at compilation. Inputs u0 … u2, outputs y0 … y2, parameters p0 … p5, states x0 … x3.
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef void *C;
enum { OK, WARNING, DISCARD, ERROR };
enum { U = 0, Y = 3, P = 6, LATE = 12, TRIES = 13, STEPS = 14, X = 15, DER = 19, ALL = 23 };
typedef struct { double v[ALL], t; int stepping; } M;

static double road(const M *m, double t) {  // a bump of height p4 [m] and length p5 [s] from 1 s on
    const double *p = m->v + P;
    return t > 1 && t < 1 + p[5] ? 0.5 * p[4] * (1 - cos(2 * M_PI * (t - 1) / p[5])) : 0;
}

static int laws(M *m, double t, const double *x, double *y, double *d) {
    const double *u = m->v + U, *p = m->v + P;
    memset(d, 0, 4 * sizeof *d);
#if LAW == 0  // linear, with the lag x
    y[0] = p[0] * u[0] + p[1] + p[2] * x[0];
    d[0] = p[3] * (u[0] - x[0]);
#elif LAW == 1  // OMSimulator 808, A: a + b + c = 0, 2a − 3b + 2c = 9
    y[0] = 1.8 - u[0], y[1] = -1.8;
#elif LAW == 2  // OMSimulator 808, B: a² + b² + c² = 5
    double rest = 5 - u[0] * u[0] - u[1] * u[1];
    if (rest < 0) return DISCARD;
    y[0] = sqrt(rest);
#elif LAW == 3  // no solution of y = u for p0 > 0.25: u² + p0
    y[0] = u[0] * u[0] + p[0];
#elif LAW == 4  // chassis: mass p0 on the force u0; y velocity, position
    y[0] = x[0], y[1] = x[1];
    d[0] = u[0] / p[0], d[1] = x[0];
#elif LAW == 5  // wheel with suspension: mass p0, tyre p1, spring p2, damper p3; u0 velocity of the chassis, y force
    double f = p[2] * (x[1] - x[2]) + p[3] * (x[0] - u[0]);
    y[0] = f, y[1] = x[1];
    d[0] = (p[1] * (road(m, t) - x[1]) - f) / p[0], d[1] = x[0], d[2] = u[0];
#endif
    return OK;
}

static int outputs(M *m) { return laws(m, m->t, m->v + X, m->v + Y, m->v + DER); }

C fmi2Instantiate(const char *n, int k, const char *g, const char *r, const void *f, int v, int l) {
    M *m = calloc(1, sizeof(M));
    return m;
}
void fmi2FreeInstance(C c) { free(c); }
int fmi2SetupExperiment(C c, int d, double tol, double t, int e, double end) { ((M *)c)->t = t; return OK; }
int fmi2EnterInitializationMode(C c) { return OK; }
int fmi2ExitInitializationMode(C c) { ((M *)c)->stepping = 1; return OK; }
int fmi2Terminate(C c) { return OK; }
int fmi2Reset(C c) { memset(c, 0, sizeof(M)); return OK; }
int fmi2SetReal(C c, const unsigned *r, size_t n, const double *v) {
    for (size_t k = 0; k < n; k++) ((M *)c)->v[r[k]] = v[k];
    return OK;
}
int fmi2GetReal(C c, const unsigned *r, size_t n, double *v) {
    M *m = c;
    int status = m->v[LATE] > 1 || (m->stepping && m->v[LATE]) ? OK : outputs(m);  // late: 1 in steps, 2 from the start
    m->v[TRIES]++;
    for (size_t k = 0; k < n; k++) v[k] = m->v[r[k]];
    return status;
}
int fmi2DoStep(C c, double t, double h, int flag) {
    M *m = c;
    double *x = m->v + X, y[3], k[4][4], s[4];
    m->v[STEPS]++;
    int parts = (int)ceil(h / 5e-5 - 1e-9);
    double e = h / parts;
    for (int i = 0; i < parts; i++) {  // RK4
        double at = t + i * e;
        laws(m, at, x, y, k[0]);
        for (int j = 0; j < 4; j++) s[j] = x[j] + 0.5 * e * k[0][j];
        laws(m, at + 0.5 * e, s, y, k[1]);
        for (int j = 0; j < 4; j++) s[j] = x[j] + 0.5 * e * k[1][j];
        laws(m, at + 0.5 * e, s, y, k[2]);
        for (int j = 0; j < 4; j++) s[j] = x[j] + e * k[2][j];
        laws(m, at + e, s, y, k[3]);
        for (int j = 0; j < 4; j++) x[j] += e / 6 * (k[0][j] + 2 * k[1][j] + 2 * k[2][j] + k[3][j]);
    }
    m->t = t + h;
    return outputs(m);
}
int fmi2GetFMUstate(C c, void **s) { *s = malloc(sizeof(M)); memcpy(*s, c, sizeof(M)); return OK; }
int fmi2SetFMUstate(C c, void *s) { double n = ((M *)c)->v[STEPS]; memcpy(c, s, sizeof(M)); ((M *)c)->v[STEPS] = n; return OK; }
int fmi2FreeFMUstate(C c, void **s) { free(*s); *s = 0; return OK; }
int fmi2GetDirectionalDerivative(C c, const unsigned *z, size_t nz, const unsigned *r, size_t n, const double *dv, double *d) {
    M a = *(M *)c, b = a;  // exact for polynomials of second degree
    for (size_t k = 0; k < n; k++) a.v[r[k]] += 1e-4 * dv[k], b.v[r[k]] -= 1e-4 * dv[k];
    if (outputs(&a) || outputs(&b)) return ERROR;
    for (size_t k = 0; k < nz; k++) d[k] = (a.v[z[k]] - b.v[z[k]]) / 2e-4;
    return OK;
}
int fmi2EnterEventMode(C c) { return OK; }
int fmi2NewDiscreteStates(C c, int *e) { memset(e, 0, 5 * sizeof(int)); return OK; }
int fmi2EnterContinuousTimeMode(C c) { return OK; }
int fmi2CompletedIntegratorStep(C c, int no, int *event, int *end) { *event = *end = 0; return OK; }
int fmi2SetTime(C c, double t) { ((M *)c)->t = t; return OK; }
int fmi2SetContinuousStates(C c, const double *x, size_t n) { return n ? ERROR : OK; }
int fmi2GetContinuousStates(C c, double *x, size_t n) { return OK; }
int fmi2GetDerivatives(C c, double *x, size_t n) { return OK; }
int fmi2GetEventIndicators(C c, double *z, size_t n) { return OK; }
int fmi2GetNominalsOfContinuousStates(C c, double *x, size_t n) { return OK; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
#define NONE(name) int name(C c) { return ERROR; }
NONE(fmi2SetDebugLogging) NONE(fmi2GetInteger) NONE(fmi2GetBoolean) NONE(fmi2GetString) NONE(fmi2SetInteger)
NONE(fmi2SetBoolean) NONE(fmi2SetString) NONE(fmi2SerializedFMUstateSize) NONE(fmi2SerializeFMUstate)
NONE(fmi2DeSerializeFMUstate) NONE(fmi2SetRealInputDerivatives) NONE(fmi2GetRealOutputDerivatives) NONE(fmi2CancelStep)
NONE(fmi2GetStatus) NONE(fmi2GetRealStatus) NONE(fmi2GetIntegerStatus) NONE(fmi2GetBooleanStatus) NONE(fmi2GetStringStatus)
