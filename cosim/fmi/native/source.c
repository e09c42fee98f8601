/* A model whose outputs are functions of time alone.
 *
 * Printed above this text: GRID, the step of the default experiment [s], CHANGES[OUTPUTS], how many changes each output has,
 * and AT, FROM, TO, RATE of all of them, output after output, the first of each before all times. From AT on an output runs
 * from FROM to TO with slope RATE a second, at once where RATE is 0. */
#include "model.h"

static double value_after(double from, double to, double rate, double elapsed)
{
    if (elapsed < 0.0) elapsed = 0.0;
    if (rate == 0.0 || fabs(to - from) <= rate * elapsed) return to;
    return from + (to > from ? rate * elapsed : -(rate * elapsed));
}

/* The last change at or before a time; one that is a step's but for rounding belongs to the step. */
static double value_at(int first, int count, double time)
{
    const double rounding = 4.0 * (nextafter(fabs(time), INFINITY) - fabs(time)) + 1e-9 * GRID;
    int low = 0, high = count;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (AT[first + middle] <= time + rounding) low = middle + 1;
        else high = middle;
    }
    const int k = first + (low > 0 ? low - 1 : 0);
    return value_after(FROM[k], TO[k], RATE[k], time - AT[k]);
}

static int refresh_outputs(Instance *m)
{
    for (int k = 0, first = 0; k < OUTPUTS; first += CHANGES[k++])
        m->values[INPUTS + k] = value_at(first, CHANGES[k], m->time);
    return 0;
}
