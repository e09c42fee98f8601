/* A monitor for scheduled execution. The partition of `minute` keeps the largest T so far; that of `alarm`, of higher
 * priority, keeps the time of the last alarm. */
#include "rest.h"

enum { T, LARGEST, ALARMED, REALS };
enum { MINUTE = 20, ALARM };
typedef struct { double real[REALS]; } Monitor;
VALUES(Monitor) STATES(Monitor)
UNUSED(fmi3InstantiateCoSimulation) UNUSED(fmi3DoStep) UNUSED(fmi3UpdateDiscreteStates) UNUSED(fmi3GetClock)
UNUSED(fmi3SetClock) UNUSED(fmi3GetIntervalDecimal) UNUSED(fmi3SetIntervalDecimal)
FINE(fmi3EnterInitializationMode)

Instance fmi3InstantiateScheduledExecution(void)
{
    Monitor *m = calloc(1, sizeof(Monitor));
    m->real[LARGEST] = -273.15;
    return m;
}

int fmi3ActivateModelPartition(Instance c, Reference clock, double t)
{
    double *r = ((Monitor *)c)->real;
    if (clock == MINUTE) r[LARGEST] = fmax(r[LARGEST], r[T]);
    if (clock == ALARM) r[ALARMED] = t;
    return OK;
}
