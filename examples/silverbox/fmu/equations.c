/* A circuit that behaves as a mass on a linear spring with a damper. */
enum { OUTPUT, RATE, OUTPUT_RATE, RATE_RATE, INPUT, FREQUENCY, DAMPING, REALS };
#define STATES 2
#define INNER 2e-4
static const double START[REALS] = {[FREQUENCY] = 430.0, [DAMPING] = 42.0};

static void equations(double *v) {
    v[OUTPUT_RATE] = v[RATE];
    v[RATE_RATE] = v[FREQUENCY] * v[FREQUENCY] * (v[INPUT] - v[OUTPUT]) - v[DAMPING] * v[RATE];
}
#include "fmi2.c"
