/* Calls of one FMU of FMI 2.0, for the benchmark of a wrapper: steps of co-simulation, or derivatives at a state. */
#include <stddef.h>

typedef int (*Set)(void *, const unsigned *, size_t, const double *);
typedef int (*Get)(void *, const unsigned *, size_t, double *);
typedef int (*Step)(void *, double, double, int);
typedef int (*SetStates)(void *, const double *, size_t);
typedef int (*GetRates)(void *, double *, size_t);

double steps(void *instance, Set set, Get get, Step step, const unsigned *references, long count, double h)
{
    double y = 0.0;
    for (long k = 0; k < count; k++) {
        const double u = (k & 64) ? 1.0 : -1.0;
        set(instance, references, 1, &u);
        step(instance, (double)k * h, h, 1);
        get(instance, references + 1, 1, &y);
    }
    return y;
}

double rates(void *instance, SetStates set, GetRates get, long count, double *x, size_t order)
{
    double rate[64], sum = 0.0;
    for (long k = 0; k < count; k++) {
        x[0] = 1e-3 * (double)(k & 63);
        set(instance, x, order);
        get(instance, rate, order);
        sum += rate[order - 1];
    }
    return sum;
}
