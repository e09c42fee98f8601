/* What a model without states is to a solver of the host: nothing. It is for co-simulation. */
#include "model.h"

static int no_solver(Instance *m)
{
    return refuse(m, "this FMU is for co-simulation only");
}

static int get_local(Instance *m, size_t k, double *value)
{
    if (k != VARIABLES) return is_kind(m, k, REAL);
    *value = m->time; /* a variable in FMI 3.0 */
    return 0;
}

static int get_states(Instance *m, double *x, size_t count)
{
    (void)x, (void)count;
    return no_solver(m);
}

static int set_states(Instance *m, const double *x, size_t count)
{
    (void)x, (void)count;
    return no_solver(m);
}

static int get_rates(Instance *m, double *dx, size_t count)
{
    (void)dx, (void)count;
    return no_solver(m);
}

static int get_crossings(Instance *m, double *z, size_t count)
{
    (void)z, (void)count;
    return no_solver(m);
}

static int update(Instance *m, double *next)
{
    (void)next;
    return no_solver(m);
}

static int complete_step(Instance *m)
{
    return no_solver(m);
}

typedef struct {
    double x[1], u[1], dx[1], dy[1];
} Direction;

static int directional_begin(Instance *m)
{
    return refuse(m, "this FMU has no directional derivatives");
}

static int direction_add(Instance *m, Direction *d, size_t k, double change)
{
    (void)d, (void)k, (void)change;
    return directional_begin(m);
}

static void direction_follow(Instance *m, Direction *d)
{
    (void)m, (void)d;
}

static int direction_read(Instance *m, const Direction *d, size_t k, double *slope)
{
    (void)d, (void)k, (void)slope;
    return directional_begin(m);
}
