/* FMI 1.0, model exchange: a ball that bounces, is kicked at a time, and counts its events and the solver's steps. */
#include <stdlib.h>
#include <string.h>

typedef void *C;
typedef unsigned int VR;
typedef void (*Logger)(C, const char *, int, const char *, const char *, ...);
typedef struct { Logger logger; void *(*allocate)(size_t, size_t); void (*release)(void *); } Callbacks;
typedef struct { char converged, references, states, end, defined; double time; } EventInfo;
enum { OK, WARNING, DISCARD, ERROR };
enum { H, V, WIND, G, E, KICK_AT, ASK_AT, END_AT, FAIL_AT, STEPS, REALS };
#define FMI(name) bounce1_fmi##name

typedef struct {
    double real[REALS], time;
    int events, upwards, asked, kicked;
    char name[50];
    Callbacks call;
} M;

const char *FMI(GetModelTypesPlatform)(void) { return "standard32"; }
const char *FMI(GetVersion)(void) { return "1.0"; }
C FMI(InstantiateModel)(const char *name, const char *guid, Callbacks call, char logging) {
    M *m = calloc(1, sizeof(M));
    (void)logging;
    if (strcmp(guid, "g")) { call.logger(m, name, ERROR, "error", "the GUID is another"); return NULL; }
    strncpy(m->name, name, sizeof m->name - 1);
    m->call = call;
    m->real[H] = 1; m->real[G] = 9.81; m->real[E] = 0.7;
    m->real[KICK_AT] = m->real[ASK_AT] = m->real[END_AT] = m->real[FAIL_AT] = 1e9;
    return m;
}
void FMI(FreeModelInstance)(C c) { free(c); }
int FMI(SetDebugLogging)(C c, char on) { (void)c; (void)on; return OK; }
int FMI(SetTime)(C c, double t) { ((M *)c)->time = t; return OK; }
int FMI(SetContinuousStates)(C c, const double x[], size_t n) { memcpy(((M *)c)->real, x, n * sizeof *x); return OK; }
int FMI(GetContinuousStates)(C c, double x[], size_t n) { memcpy(x, ((M *)c)->real, n * sizeof *x); return OK; }
int FMI(GetNominalContinuousStates)(C c, double x[], size_t n) {
    (void)c;
    while (n--) x[n] = 1;
    return OK;
}
int FMI(GetStateValueReferences)(C c, VR r[], size_t n) {
    (void)c;
    while (n--) r[n] = n;
    return OK;
}
int FMI(GetDerivatives)(C c, double dx[], size_t n) {
    M *m = c;
    (void)n;
    if (m->time > m->real[FAIL_AT]) { m->call.logger(m, m->name, ERROR, "error", "it has a hole"); return ERROR; }
    dx[0] = m->real[V];
    dx[1] = m->real[WIND] - m->real[G];
    return OK;
}
int FMI(GetEventIndicators)(C c, double z[], size_t n) { (void)n; z[0] = ((M *)c)->real[H]; return OK; }
int FMI(CompletedIntegratorStep)(C c, char *event) {
    M *m = c;
    m->real[STEPS] += 1;
    *event = !m->asked && m->time >= m->real[ASK_AT];
    m->asked |= *event;
    return OK;
}
static void next_event(M *m, EventInfo *info) {
    memset(info, 0, sizeof *info);
    info->converged = 1;
    info->defined = !m->kicked && m->real[KICK_AT] < 1e9;
    info->time = m->real[KICK_AT];
    info->end = m->time >= m->real[END_AT];
}
int FMI(Initialize)(C c, char controlled, double tolerance, EventInfo *info) {
    (void)controlled; (void)tolerance;
    next_event(c, info);
    return OK;
}
int FMI(EventUpdate)(C c, char intermediate, EventInfo *info) {
    M *m = c;
    int bounced = m->real[H] <= 0 && m->real[V] < 0, due = !m->kicked && m->time >= m->real[KICK_AT] - 1e-9;
    (void)intermediate;
    m->events++;
    if (bounced) { m->real[H] = 0; m->real[V] *= -m->real[E]; }
    if (due) { m->real[V] += 1; m->kicked = 1; }
    next_event(m, info);
    info->states = bounced || due;
    return OK;
}
int FMI(Terminate)(C c) { (void)c; return OK; }
int FMI(GetReal)(C c, const VR r[], size_t n, double v[]) { while (n--) v[n] = ((M *)c)->real[r[n]]; return OK; }
int FMI(SetReal)(C c, const VR r[], size_t n, const double v[]) { while (n--) ((M *)c)->real[r[n]] = v[n]; return OK; }
int FMI(GetInteger)(C c, const VR r[], size_t n, int v[]) { (void)r; while (n--) v[n] = ((M *)c)->events; return OK; }
int FMI(SetInteger)(C c, const VR r[], size_t n, const int v[]) { (void)c; (void)r; (void)n; (void)v; return ERROR; }
int FMI(GetBoolean)(C c, const VR r[], size_t n, char v[]) { (void)r; while (n--) v[n] = ((M *)c)->real[V] > 0; return OK; }
int FMI(SetBoolean)(C c, const VR r[], size_t n, const char v[]) { (void)c; (void)r; (void)n; (void)v; return ERROR; }
int FMI(GetString)(C c, const VR r[], size_t n, const char *v[]) { (void)r; while (n--) v[n] = ((M *)c)->name; return OK; }
int FMI(SetString)(C c, const VR r[], size_t n, const char *const v[]) { (void)c; (void)r; (void)n; (void)v; return ERROR; }
