/* Calls of the library of an FMU, of FMI 2.0 or 3.0: NB states (in co-simulation outputs), NU inputs and NL outputs.
 *
 * `library_inputs`, which stands below this text, gives the inputs that the library gets. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#define MOST_STATUS 1 /* OK and Warning */

typedef int (*SetTime)(void *, double);
typedef int (*SetStates)(void *, const double *, size_t);
typedef int (*GetRates)(void *, double *, size_t);
typedef int (*Complete2)(void *, int, int *, int *);
typedef int (*Complete3)(void *, bool, bool *, bool *);
typedef int (*Step2)(void *, double, double, int);
typedef int (*Step3)(void *, double, double, bool, bool *, bool *, bool *, double *);
typedef int (*SetReals2)(void *, const unsigned *, size_t, const double *);
typedef int (*GetReals2)(void *, const unsigned *, size_t, double *);
typedef int (*SetReals3)(void *, const unsigned *, size_t, const double *, size_t);
typedef int (*GetReals3)(void *, const unsigned *, size_t, double *, size_t);
typedef void (*Function)(void);

typedef struct Library { /* functions of the other interface are NULL */
    void *instance;
    Function set_time, set_states, get_rates;
    Function complete; /* told of each substep; NULL if the FMU needs none */
    Function step, set_reals, get_reals;
    const unsigned *inputs, *outputs;
    const double *steps; /* NB: step of each state for differences */
    int version, directions;
    const struct Library *second; /* with changes of the dampings; NULL where no term acts along a direction */
    const int *braked; /* directions: state, usual speed, and change of the damping */
    const double *speeds, *changes;
} Library;

static __thread const Library *library; /* a thread has an instance of its own */

static void library_inputs(double t, const double *x, const double *u, const double *p, double *out);

static int put_inputs(double t, const double *x, const double *u, const double *p)
{
    double acting[NU + 1];
    if (!NU) return 0;
    library_inputs(t, x, u, p, acting);
    if (library->version == 2) return ((SetReals2)library->set_reals)(library->instance, library->inputs, NU, acting);
    return ((SetReals3)library->set_reals)(library->instance, library->inputs, NU, acting, NU);
}

static int get_outputs(double *out)
{
    if (library->version == 2) return ((GetReals2)library->get_reals)(library->instance, library->outputs, NL, out);
    return ((GetReals3)library->get_reals)(library->instance, library->outputs, NL, out, NL);
}
