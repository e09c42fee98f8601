/* A carriage on a rail with viscous friction. */
enum { POSITION, VELOCITY, POSITION_RATE, VELOCITY_RATE, FORCE, MASS, VISCOUS, REALS };
#define STATES 2
#define INNER 1e-3
static const double START[REALS] = {[MASS] = 95.0, [VISCOUS] = 200.0};

static void equations(double *v) {
    v[POSITION_RATE] = v[VELOCITY];
    v[VELOCITY_RATE] = (v[FORCE] - v[VISCOUS] * v[VELOCITY]) / v[MASS];
}
#include "fmi2.c"
