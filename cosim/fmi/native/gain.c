/* A model whose outputs are FACTOR * input + OFFSET, printed above this text, one of each for an output. */
#include "model.h"

static int refresh_outputs(Instance *m)
{
    for (int k = 0; k < OUTPUTS; k++)
        m->values[INPUTS + k] = FACTOR[k] * m->values[k] + OFFSET[k];
    return 0;
}

static int initialize(Instance *m)
{
    if (check_bounds(m)) return 1;
    m->time = m->start_time;
    return refresh_outputs(m);
}

static int advance(Instance *m, double t, double h)
{
    m->time = t + h;
    return refresh_outputs(m);
}

static void after_restore(Instance *m)
{
    (void)m;
}
