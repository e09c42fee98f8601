/* A heated tank: C dT/dt = P − k (T − ambient). The clock `over` ticks when T rises through `limit`. */
#include "rest.h"

enum { P, T, LIMIT, CAPACITY, LOSS, AMBIENT, CROSSINGS, REALS };
enum { OVER = 20 };
typedef struct {
    double real[REALS], time;
    bool crossing, is_over; /* at the limit now; ticking */
} Tank;
VALUES(Tank) STATES(Tank)
UNUSED(fmi3InstantiateScheduledExecution) UNUSED(fmi3ActivateModelPartition) UNUSED(fmi3SetClock)
UNUSED(fmi3GetIntervalDecimal) UNUSED(fmi3SetIntervalDecimal)

Instance fmi3InstantiateCoSimulation(void)
{
    Tank *m = calloc(1, sizeof(Tank));
    m->real[T] = m->real[AMBIENT] = 20.0;
    m->real[LIMIT] = 60.0;
    m->real[CAPACITY] = 4000.0;
    m->real[LOSS] = 20.0;
    return m;
}

int fmi3EnterInitializationMode(Instance c, bool has_tolerance, double tolerance, double start)
{
    (void)has_tolerance;
    (void)tolerance;
    ((Tank *)c)->time = start;
    return OK;
}

int fmi3GetClock(Instance c, const Reference *v, size_t n, bool *x)
{
    Tank *m = c;
    m->is_over = m->crossing;
    while (n--) x[n] = v[n] == OVER && m->is_over;
    return OK;
}

int fmi3UpdateDiscreteStates(Instance c, bool *more, bool *end, bool *nominals, bool *states, bool *known, double *next)
{
    Tank *m = c;
    *more = *end = *nominals = *states = *known = false;
    *next = 0.0;
    if (m->crossing) m->real[CROSSINGS] += 1.0;
    m->crossing = m->is_over = false;
    return OK;
}

int fmi3DoStep(Instance c, double t, double h, bool no, bool *event, bool *end, bool *early, double *last)
{
    Tank *m = c;
    double *r = m->real;
    const double lag = r[CAPACITY] / r[LOSS], final = r[AMBIENT] + r[P] / r[LOSS];
    double reached = t + h;
    (void)no;
    *event = *end = *early = false;
    if (r[T] < r[LIMIT] && final > r[LIMIT]) { /* T = final + (T0 − final) exp(−t / lag) reaches the limit */
        const double at = t - lag * log((final - r[LIMIT]) / (final - r[T]));
        if (at <= reached) {
            reached = at;
            *event = m->crossing = true;
            *early = at < t + h;
        }
    }
    r[T] = m->crossing ? r[LIMIT] : final + (r[T] - final) * exp(-(reached - t) / lag);
    m->time = *last = reached;
    return OK;
}
