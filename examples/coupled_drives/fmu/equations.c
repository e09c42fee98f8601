/* Two motors that drive a pulley by a belt: a lag of the drive, then a pulley on a spring. */
enum { SPEED, RATE, DRIVE, SPEED_RATE, RATE_RATE, DRIVE_RATE, VOLTAGE, GAIN, DRIVE_POLE, FREQUENCY, DAMPING, REALS };
#define STATES 3
#define INNER 2e-3
static const double START[REALS] = {
    [GAIN] = 1.8212, [DRIVE_POLE] = 6.7351, [FREQUENCY] = 20.5166, [DAMPING] = 0.32157,
};

static void equations(double *v) {
    const double w = v[FREQUENCY];
    v[SPEED_RATE] = v[RATE];
    v[RATE_RATE] = w * w * (v[DRIVE] - v[SPEED]) - 2.0 * v[DAMPING] * w * v[RATE];
    v[DRIVE_RATE] = v[DRIVE_POLE] * (v[GAIN] * v[VOLTAGE] - v[DRIVE]);
}
#include "fmi2.c"
