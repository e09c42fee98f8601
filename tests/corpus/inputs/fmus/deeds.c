/* An FMU for co-simulation (FMI 2.0) that does a deed at the n-th call of a function, as resources/deed.txt says:
   "DoStep segfault 5". Inputs 0..9, outputs 10..19; output 10 counts the steps. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

typedef void *Component;
typedef void (*Logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished, *environment;
} Callbacks;
enum { OK, WARNING, DISCARD, ERROR, FATAL };

static char where[64], deed[64], folder[4096];
static int at, calls;
static const Callbacks *callbacks;
static char name[256];
static int ended;
static volatile int sink;
static void *volatile kept;

typedef struct { double values[20], time; int steps; } State;

static int deeper(int n) {
    volatile char frame[4096];
    frame[n % 4096] = (char)n;
    return deeper(n + 1) + frame[(n + 1) % 4096];
}

static int act(void) {
    if (!strcmp(deed, "segfault")) *(volatile int *)0 = 1;
    if (!strcmp(deed, "abort")) { fprintf(stderr, "deeds.c: pressure < limit failed\n"); abort(); }
    if (!strcmp(deed, "exit")) exit(0);
    if (!strcmp(deed, "overflow")) sink = deeper(0);
    if (!strcmp(deed, "division")) raise(SIGFPE);
    if (!strcmp(deed, "hang")) for (;;) sink++;
    if (!strcmp(deed, "sleep")) for (;;) pause();
    if (!strcmp(deed, "memory")) for (;;) { kept = malloc(1 << 20); if (kept) memset(kept, 1, 1 << 20); usleep(500); }
    if (!strcmp(deed, "print")) for (;;) puts("the same again and again, and again, and again");
    if (!strcmp(deed, "log"))
        for (;;) callbacks->logger(callbacks->environment, name, WARNING, "warning", "step %d of the pump", at);
    if (!strcmp(deed, "free")) { int *p = malloc(64); free(p); kept = p; free(kept); }
    if (!strcmp(deed, "folder")) { sink = chdir("/"); setenv("DEED", "done", 1); }
    if (!strcmp(deed, "kill")) kill(getpid(), SIGKILL);
    if (!strcmp(deed, "terminate")) kill(getpid(), SIGTERM);
    if (!strcmp(deed, "child") && fork() == 0) for (;;) pause();
    if (!strcmp(deed, "away") && fork() == 0) {
        FILE *file = fopen(getenv("DEED_AWAY"), "w");
        setsid();
        fprintf(file, "%d", getpid());
        fclose(file);
        sleep(60);
        remove(getenv("DEED_AWAY"));
        _exit(0);
    }
    if (!strcmp(deed, "children")) { fork(); for (;;) pause(); }
    if (!strcmp(deed, "grow") || !strcmp(deed, "orphan")) {
        int ends[2];
        char byte = 0;
        sink = pipe(ends);
        if (fork() == 0) {
            if (deed[0] == 'o' && fork()) _exit(0); /* the parent of the orphan ends at once */
            kept = malloc(330 << 20);
            memset(kept, 1, 330 << 20);
            sink = (int)write(ends[1], &byte, 1);
            for (;;) pause();
        }
        sink = (int)read(ends[0], &byte, 1);
    }
    if (!strcmp(deed, "share")) { /* pages of parent and children, counted once */
        kept = malloc(150 << 20); memset(kept, 1, 150 << 20);
        for (int k = 0; k < 3; k++) if (fork() == 0) for (;;) pause();
    }
    if (strchr("gos", deed[0]) && strstr("grow orphan share", deed)) usleep(800000);
    if (!strcmp(deed, "close")) { for (int k = 0; k < 64; k++) close(k); for (;;) pause(); }
    if (!strcmp(deed, "closes")) for (int k = 0; k <= 20; k++) close(k);
    if (!strcmp(deed, "closes_all")) for (int k = 0; k < 1024; k++) close(k);
    if (!strcmp(deed, "writes")) for (int k = 0; k < 1024; k++) sink = (int)write(k, "not a message of any protocol\n", 30);
    if (!strcmp(deed, "reads"))
        for (int k = 0; k < 1024; k++) {
            char part[4096];
            fcntl(k, F_SETFL, O_NONBLOCK);
            sink = (int)read(k, part, sizeof part);
        }
    if (!strcmp(deed, "redirects")) for (int k = 0; k <= 20; k++) dup2(open("/dev/null", O_RDWR), k);
    if (!strcmp(deed, "pipe")) { char c; sink = (int)read(0, &c, 1); }
    if (!strcmp(deed, "slow")) usleep(20000);
    if (!strcmp(deed, "warning")) return WARNING;
    if (!strcmp(deed, "discard")) return DISCARD;
    if (!strcmp(deed, "end")) { ended = 1; return DISCARD; }
    if (!strcmp(deed, "error")) return ERROR;
    if (!strcmp(deed, "fatal")) return FATAL;
    return OK;
}

static int now(const char *function) {
    if (strcmp(function, where)) return OK;
    calls++;
    if (!(calls == at || (at == 0))) return OK;
    if (callbacks && strcmp(deed, "log") && at)
        callbacks->logger(callbacks->environment, name, OK, "info", "%s: %s", function, deed);
    return act();
}

__attribute__((constructor)) static void load(void) {
    Dl_info here;
    char path[4200];
    if (!dladdr((void *)&load, &here)) return;
    snprintf(folder, sizeof folder, "%s", here.dli_fname);
    for (int k = 0; k < 3; k++) { char *cut = strrchr(folder, '/'); if (cut) *cut = 0; }
    snprintf(path, sizeof path, "%s/resources/deed.txt", folder);
    FILE *file = fopen(path, "r");
    if (!file) return;
    if (fscanf(file, "%63s %63s %d", where, deed, &at) != 3) where[0] = 0;
    fclose(file);
    now("load");
}

__attribute__((destructor)) static void unload(void) { callbacks = 0; now("unload"); }

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
Component fmi2Instantiate(const char *instance, int kind, const char *guid, const char *resources,
                          const Callbacks *functions, int visible, int logging) {
    callbacks = functions;
    snprintf(name, sizeof name, "%s", instance);
    return now("Instantiate") > DISCARD ? NULL : calloc(1, sizeof(State));
}
void fmi2FreeInstance(Component c) { now("FreeInstance"); callbacks = 0; free(c); }
int fmi2SetDebugLogging(Component c, int on, size_t n, const char *const *categories) { return OK; }
int fmi2SetupExperiment(Component c, int d, double t, double s, int e, double x) { return now("SetupExperiment"); }
int fmi2EnterInitializationMode(Component c) { return now("EnterInitializationMode"); }
int fmi2ExitInitializationMode(Component c) { return now("ExitInitializationMode"); }
int fmi2Terminate(Component c) { return now("Terminate"); }
int fmi2Reset(Component c) { memset(c, 0, sizeof(State)); return now("Reset"); }
int fmi2SetReal(Component c, const unsigned r[], size_t n, const double v[]) {
    State *s = c;
    for (size_t k = 0; k < n; k++) s->values[r[k] % 20] = v[k];
    return now("SetReal");
}
int fmi2GetReal(Component c, const unsigned r[], size_t n, double v[]) {
    State *s = c;
    for (size_t k = 0; k < n; k++) v[k] = s->values[r[k] % 20];
    if (!strcmp(deed, "nan") && s->steps >= at) v[0] = NAN;
    return now("GetReal");
}
int fmi2DoStep(Component c, double t, double h, int no) {
    State *s = c;
    s->steps++;
    for (int k = 11; k < 20; k++) s->values[k] += h * (s->values[k - 10] - s->values[k] + sin(t));
    s->values[10] = s->steps;
    int status = now("DoStep");
    s->time = status < DISCARD ? t + h : t;
    return status;
}
int fmi2GetBooleanStatus(Component c, int kind, int *value) { *value = ended; return OK; }
int fmi2GetRealStatus(Component c, int kind, double *value) { *value = ((State *)c)->time; return OK; }

#define REST(function, ...) int function(__VA_ARGS__) { return ERROR; }
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
REST(fmi2GetIntegerStatus, Component c, int k, int *v)
REST(fmi2GetStringStatus, Component c, int k, const char **v)
