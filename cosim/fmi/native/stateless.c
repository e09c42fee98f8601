/* A model whose outputs follow from time and inputs alone: refresh_outputs() is all of it. */
#include "model.h"

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
