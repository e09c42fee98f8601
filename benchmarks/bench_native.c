/* The craft's loop as one writes it by hand, for the benchmark: two FMUs of FMI 2.0, Jacobi, 20 variables recorded, no check. */
#include <stddef.h>

typedef int (*Set)(void *, const unsigned *, size_t, const double *);
typedef int (*Get)(void *, const unsigned *, size_t, double *);
typedef int (*Step)(void *, double, double, int);

typedef struct {
    void *instance;
    Set set;
    Get get;
    Step step;
    const unsigned *inputs, *outputs; /* value references: 4 and 15 of the plant, 3 and 5 of the controller */
} Part;

void drive(const Part *plant, const Part *controller, long steps, double h, double *table)
{
    double measured[3];
    plant->get(plant->instance, plant->outputs, 15, table);
    controller->get(controller->instance, controller->outputs, 5, table + 15);
    for (long k = 0; k < steps; k++, table += 20) {
        measured[0] = table[4], measured[1] = table[8], measured[2] = table[10]; /* psi, psi_dot, ax */
        plant->set(plant->instance, plant->inputs, 4, table + 15);
        controller->set(controller->instance, controller->inputs, 3, measured);
        plant->step(plant->instance, (double)k * h, h, 1);
        controller->step(controller->instance, (double)k * h, h, 1);
        plant->get(plant->instance, plant->outputs, 15, table + 20);
        controller->get(controller->instance, controller->outputs, 5, table + 35);
    }
}
