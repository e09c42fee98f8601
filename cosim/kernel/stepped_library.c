/* The library of an FMU for co-simulation: a substep is one of its steps, and its outputs stand in place of states.
 *
 * NB outputs and NU inputs of the library; `library_inputs`, which stands below this text, gives the inputs that it gets. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#define MOST_STATUS 1 /* OK and Warning */

typedef int (*Step2)(void *, double, double, int);
typedef int (*Step3)(void *, double, double, bool, bool *, bool *, bool *, double *);
typedef int (*SetReals2)(void *, const unsigned *, size_t, const double *);
typedef int (*GetReals2)(void *, const unsigned *, size_t, double *);
typedef int (*SetReals3)(void *, const unsigned *, size_t, const double *, size_t);
typedef int (*GetReals3)(void *, const unsigned *, size_t, double *, size_t);
typedef void (*Function)(void);

typedef struct {
    void *instance;
    Function step, unused, unused_too, set_reals, get_reals;
    const unsigned *inputs, *outputs;
    const double *steps;
    int version;
    Function complete;
} Library;

static __thread const Library *library; /* a thread has an instance of its own */

static void library_inputs(double t, const double *x, const double *u, const double *p, double *out);

/* Called before each run, with the instance of this thread. */
void use_library(const Library *used)
{
    library = used;
}

static int read_library(double *x)
{
    void *instance = library->instance;
    if (library->version == 2) return ((GetReals2)library->get_reals)(instance, library->outputs, NB, x);
    return ((GetReals3)library->get_reals)(instance, library->outputs, NB, x, NB);
}

static int set_library(double t, const double *x, const double *u, const double *p)
{
    double acting[NU + 1];
    if (!NU) return 0;
    library_inputs(t, x, u, p, acting);
    if (library->version == 2) return ((SetReals2)library->set_reals)(library->instance, library->inputs, NU, acting);
    return ((SetReals3)library->set_reals)(library->instance, library->inputs, NU, acting, NU);
}

static void step_library(double t, double h, double *x, const double *u, const double *p)
{
    bool event = false, terminate = false, early = false;
    double reached = t + h;
    int status = set_library(t, x, u, p);
    if (status <= MOST_STATUS)
        status = library->version == 2
                     ? ((Step2)library->step)(library->instance, t, h, 1)
                     : ((Step3)library->step)(library->instance, t, h, true, &event, &terminate, &early, &reached);
    if (status <= MOST_STATUS) status = read_library(x);
    if (status > MOST_STATUS || terminate || early) x[0] = NAN;
}
