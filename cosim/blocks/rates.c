/* Rates of a model-exchange FMU for CVODE, without a call into Python; see solvers.py. */
#include <math.h>
#include <stddef.h>

enum { WARNING = 1, DISCARD = 2 };

typedef struct {
    void *instance;
    int (*set_time)(void *, double);
    int (*set_states)(void *, const double *, size_t);
    int (*get_rates)(void *, double *, size_t);
    size_t states;
    size_t data;     /* offset of the pointer to the numbers within the content of a vector */
    int refusals;    /* points at which CVODE was asked for a shorter step */
    int call;        /* number of the last call whose status was above WARNING */
    int status;      /* its status; 0 if a rate was not finite */
    ptrdiff_t place; /* index of the last rate that was not finite, and the rate */
    double rate;
    double start;    /* time of the run at which CVODE's time is 0 */
} Model;

int rates(double t, void **y, void **dy, Model *m) {
    const double *x = *(double **)((char *)*y + m->data);
    double *dx = *(double **)((char *)*dy + m->data);
    int call = 0, status = m->set_time(m->instance, m->start + t);
    if (status <= WARNING) {
        call = 1;
        status = m->set_states(m->instance, x, m->states);
    }
    if (status <= WARNING) {
        call = 2;
        status = m->get_rates(m->instance, dx, m->states);
    }
    if (status > WARNING) {
        m->call = call;
        m->status = status;
        m->refusals++;
        return status == DISCARD ? 1 : -1;
    }
    for (size_t k = 0; k < m->states; k++)
        if (!isfinite(dx[k])) {
            m->place = (ptrdiff_t)k;
            m->rate = dx[k];
            m->status = 0;
            m->refusals++;
            return 1;
        }
    return 0;
}
