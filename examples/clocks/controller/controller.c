/* A clocked PI controller. Each tick of `sample` reads T and sets P; `cut` sets P = 0 for `pause` seconds, until the
 * countdown clock `resume` ticks. A cut clears the integral, which stands still at the limits of P. */
#include "rest.h"

enum { T, P, SETPOINT, GAIN, RESET_TIME, MAXIMUM, PAUSE, CUTS, REALS };
enum { SAMPLE = 20, CUT, RESUME };
typedef struct {
    double real[REALS], interval, integral;
    bool samples, cuts, resumes, waits; /* clocks that tick now; whether P is cut */
    int pause_changed;
} Controller;
VALUES(Controller) STATES(Controller)
UNUSED(fmi3InstantiateScheduledExecution) UNUSED(fmi3ActivateModelPartition) UNUSED(fmi3GetClock)

Instance fmi3InstantiateCoSimulation(void)
{
    Controller *m = calloc(1, sizeof(Controller));
    m->real[SETPOINT] = 55.0;
    m->real[GAIN] = 100.0;
    m->real[RESET_TIME] = 30.0;
    m->real[MAXIMUM] = 2000.0;
    m->real[PAUSE] = 30.0;
    m->interval = 2.0;
    return m;
}

FINE(fmi3EnterInitializationMode)

int fmi3SetIntervalDecimal(Instance c, const Reference *v, size_t n, const double *x)
{
    while (n--)
        if (v[n] == SAMPLE) ((Controller *)c)->interval = x[n];
    return OK;
}

int fmi3GetIntervalDecimal(Instance c, const Reference *v, size_t n, double *x, int *qualifier)
{
    Controller *m = c;
    while (n--) {
        x[n] = v[n] == RESUME ? m->real[PAUSE] : m->interval;
        qualifier[n] = v[n] == RESUME ? m->pause_changed : UNCHANGED;
        if (v[n] == RESUME && m->pause_changed == CHANGED) m->pause_changed = UNCHANGED;
    }
    return OK;
}

int fmi3SetClock(Instance c, const Reference *v, size_t n, const bool *x)
{
    Controller *m = c;
    while (n--) {
        if (v[n] == SAMPLE) m->samples = x[n];
        if (v[n] == CUT) m->cuts = x[n];
        if (v[n] == RESUME) m->resumes = x[n];
    }
    return OK;
}

int fmi3UpdateDiscreteStates(Instance c, bool *more, bool *end, bool *nominals, bool *states, bool *known, double *next)
{
    Controller *m = c;
    double *r = m->real;
    *more = *end = *nominals = *states = *known = false;
    *next = 0.0;
    if (m->cuts) {
        r[CUTS] += 1.0;
        r[P] = 0.0;
        m->integral = 0.0;
        m->waits = true;
        m->pause_changed = CHANGED;
    }
    if (m->resumes) m->waits = false;
    if (m->samples && !m->waits) {
        const double error = r[SETPOINT] - r[T], wanted = r[GAIN] * (error + m->integral / r[RESET_TIME]);
        r[P] = fmin(fmax(wanted, 0.0), r[MAXIMUM]);
        if (r[P] == wanted) m->integral += error * m->interval;
    }
    m->samples = m->cuts = m->resumes = false;
    return OK;
}

int fmi3DoStep(Instance c, double t, double h, bool no, bool *event, bool *end, bool *early, double *last)
{
    (void)c;
    (void)no;
    *event = *end = *early = false;
    *last = t + h;
    return OK;
}
