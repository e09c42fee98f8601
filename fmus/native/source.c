/* An FMU whose outputs are functions of time alone, FMI 2.0 for co-simulation. Above this text stand GUID, IDENTIFIER,
 * SIGNALS, COUNT[SIGNALS] and the changes of each signal in time: AT, FROM, TO and RATE, one after the other, the first before
 * all times. From AT on a signal runs from FROM to TO with slope RATE a second, at once where RATE is 0. All symbols but FMI's are hidden. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { OK, WARNING, DISCARD, ERROR, FATAL };

typedef void (*Logger)(void *environment, const char *name, int status, const char *category, const char *text, ...);

typedef struct {
    Logger logger;
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*finished)(void *environment, int status);
    void *environment;
} Callbacks;

typedef struct {
    double time;
    const Callbacks *callbacks;
    char *name;
} Instance;

static double reached(double from, double to, double rate, double elapsed)
{
    if (elapsed < 0.0) elapsed = 0.0;
    if (rate == 0.0 || fabs(to - from) <= rate * elapsed) return to;
    return from + (to > from ? rate * elapsed : -(rate * elapsed));
}

/* The last change at or before a time; one that is a step's but for rounding belongs to the step. */
static double value(int signal, double time)
{
    int first = 0;
    for (int k = 0; k < signal; k++) first += COUNT[k];
    int low = 0, high = COUNT[signal];
    while (low < high) {
        int middle = (low + high) / 2;
        if (AT[first + middle] <= time + 1e-9) low = middle + 1; else high = middle;
    }
    int k = first + (low > 0 ? low - 1 : 0);
    return reached(FROM[k], TO[k], RATE[k], time - AT[k]);
}

static int refused(const Instance *self, const char *text)
{
    if (self->callbacks->logger)
        self->callbacks->logger(self->callbacks->environment, self->name, ERROR, "logStatusError", "%s", text);
    return ERROR;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                             const Callbacks *callbacks, int visible, int logging)
{
    (void)resources, (void)visible, (void)logging;
    if (!name || !guid || !callbacks || type != 1 || strcmp(guid, GUID)) return NULL;
    Instance *self = calloc(1, sizeof *self);
    if (!self) return NULL;
    self->callbacks = callbacks;
    self->name = malloc(strlen(name) + 1);
    if (!self->name) {
        free(self);
        return NULL;
    }
    strcpy(self->name, name);
    return self;
}

EXPORT void fmi2FreeInstance(void *instance)
{
    if (!instance) return;
    free(((Instance *)instance)->name);
    free(instance);
}

EXPORT int fmi2SetupExperiment(void *instance, int defined, double tolerance, double start, int ends, double stop)
{
    (void)defined, (void)tolerance, (void)ends, (void)stop;
    ((Instance *)instance)->time = start;
    return OK;
}

EXPORT int fmi2DoStep(void *instance, double time, double step, int kept)
{
    (void)kept;
    if (!(step >= 0.0)) return refused(instance, "a communication step is not negative");
    ((Instance *)instance)->time = time + step;
    return OK;
}

EXPORT int fmi2GetReal(void *instance, const unsigned *references, size_t count, double *values)
{
    for (size_t k = 0; k < count; k++) {
        if (references[k] >= SIGNALS) return refused(instance, "there is no Real of this value reference");
        values[k] = value((int)references[k], ((Instance *)instance)->time);
    }
    return OK;
}

EXPORT int fmi2EnterInitializationMode(void *instance) { (void)instance; return OK; }
EXPORT int fmi2ExitInitializationMode(void *instance) { (void)instance; return OK; }
EXPORT int fmi2Terminate(void *instance) { (void)instance; return OK; }
EXPORT int fmi2Reset(void *instance) { ((Instance *)instance)->time = 0.0; return OK; }
EXPORT int fmi2CancelStep(void *instance) { return refused(instance, "no step is pending"); }

EXPORT int fmi2SetDebugLogging(void *instance, int on, size_t count, const char *const categories[])
{
    (void)instance, (void)on, (void)count, (void)categories;
    return OK;
}

/* The state is the time. */
EXPORT int fmi2GetFMUstate(void *instance, void **state)
{
    if (!*state) *state = malloc(sizeof(double));
    if (!*state) return refused(instance, "no memory");
    *(double *)*state = ((Instance *)instance)->time;
    return OK;
}

EXPORT int fmi2SetFMUstate(void *instance, void *state)
{
    ((Instance *)instance)->time = *(double *)state;
    return OK;
}

EXPORT int fmi2FreeFMUstate(void *instance, void **state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT int fmi2SerializedFMUstateSize(void *instance, void *state, size_t *size)
{
    (void)instance, (void)state;
    *size = sizeof(double);
    return OK;
}

EXPORT int fmi2SerializeFMUstate(void *instance, void *state, char bytes[], size_t size)
{
    if (size < sizeof(double)) return refused(instance, "too little room for the state");
    memcpy(bytes, state, sizeof(double));
    return OK;
}

EXPORT int fmi2DeSerializeFMUstate(void *instance, const char bytes[], size_t size, void **state)
{
    if (size != sizeof(double)) return refused(instance, "that is no state of this FMU");
    if (!*state) *state = malloc(sizeof(double));
    if (!*state) return refused(instance, "no memory");
    memcpy(*state, bytes, sizeof(double));
    return OK;
}

/* What it has none of. */
#define NONE(name, type) \
    EXPORT int name(void *instance, const unsigned *references, size_t count, type values) \
    { (void)references, (void)values; return count ? refused(instance, #name ": it has none such") : OK; }
NONE(fmi2GetInteger, int *)
NONE(fmi2GetBoolean, int *)
NONE(fmi2GetString, const char **)
NONE(fmi2SetReal, const double *)
NONE(fmi2SetInteger, const int *)
NONE(fmi2SetBoolean, const int *)
NONE(fmi2SetString, const char *const *)

EXPORT int fmi2GetDirectionalDerivative(void *instance, const unsigned *of, size_t rows, const unsigned *by, size_t columns,
                                        const double *seed, double *values)
{
    (void)of, (void)by, (void)seed, (void)values;
    return rows && columns ? refused(instance, "it has no inputs") : OK;
}

EXPORT int fmi2SetRealInputDerivatives(void *instance, const unsigned *references, size_t count, const int *orders,
                                       const double *values)
{
    (void)references, (void)orders, (void)values;
    return count ? refused(instance, "it has no inputs") : OK;
}

EXPORT int fmi2GetRealOutputDerivatives(void *instance, const unsigned *references, size_t count, const int *orders,
                                        double *values)
{
    (void)references, (void)orders, (void)values;
    return count ? refused(instance, "it gives no derivatives of outputs") : OK;
}

#define STATUS(name, type) \
    EXPORT int name(void *instance, int kind, type *value) \
    { (void)instance, (void)kind, (void)value; return DISCARD; }
STATUS(fmi2GetStatus, int)
STATUS(fmi2GetRealStatus, double)
STATUS(fmi2GetIntegerStatus, int)
STATUS(fmi2GetBooleanStatus, int)
STATUS(fmi2GetStringStatus, const char *)
