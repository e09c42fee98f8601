/* Heater and air in a box that loses heat to the room.
 *
 * title: Heated box
 * inner: 0.5
 * input: heater 0.0 1 share of the power
 * input: T_room 295.0 K temperature of the room
 * state: T_heater 295.0 K temperature of the heater
 * state: T_air 295.0 K temperature of the air
 * shown: T_heater T_air
 * parameter: power 100.0 W 0.05 power of the heater
 * parameter: C_heater 120.0 J/K 0.1 heat capacity of the heater
 * parameter: C_air 300.0 J/K 0.1 heat capacity of the air and the walls
 * parameter: G_heater 3.0 W/K 0.1 conductance from heater to air
 * parameter: G_wall 1.5 W/K 0.1 conductance to the room
 */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double flow = p[3] * (x[0] - x[1]);
    dx[0] = (p[0] * u[0] - flow) / p[1];
    dx[1] = (flow - p[4] * (x[1] - u[1])) / p[2];
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
