/* A box with a heater: one heat capacity and one loss to the room. */
enum { T, T_RATE, POWER, T_ROOM, C_AIR, G_BOX, REALS };
#define STATES 1
#define INNER 1.0
static const double START[REALS] = {[T] = 295.0, [T_ROOM] = 295.0, [C_AIR] = 498.71218224, [G_BOX] = 0.62551039};

static void equations(double *v) { v[T_RATE] = (v[POWER] - v[G_BOX] * (v[T] - v[T_ROOM])) / v[C_AIR]; }
#include "fmi2.c"
