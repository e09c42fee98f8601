/* The library of an FMU for co-simulation: a substep is one of its steps, and its outputs stand in place of states. */

/* What the filter adds to positions of the run: a force along a position acts where the machine is. */
static __thread double moved_by[NB + 1];
static __thread int is_moved;

static int put_inputs_there(double t, const double *x, const double *u, const double *p)
{
    double there[NX + 1];
    if (!is_moved) return put_inputs(t, x, u, p);
    memcpy(there, x, sizeof(double) * NX);
    for (int j = 0; j < NB; j++) there[j] += moved_by[j];
    return put_inputs(t, there, u, p);
}

/* Called before each run, with the instance of this thread. */
void use_library(const Library *used)
{
    library = used;
}

/* At the start of a run. */
static int begin_library(double t, double *x, const double *u, const double *p)
{
    const int status = put_inputs_there(t, x, u, p);
    return status <= MOST_STATUS ? get_outputs(x) : status;
}

static void step_library(double t, double h, double *x, const double *u, const double *p)
{
    bool event = false, terminate = false, early = false;
    double reached = t + h;
    int status = put_inputs_there(t, x, u, p);
    if (status <= MOST_STATUS)
        status = library->version == 2
                     ? ((Step2)library->step)(library->instance, t, h, 1)
                     : ((Step3)library->step)(library->instance, t, h, true, &event, &terminate, &early, &reached);
    if (status <= MOST_STATUS) status = get_outputs(x);
    if (status > MOST_STATUS || terminate || early) x[0] = NAN;
}
