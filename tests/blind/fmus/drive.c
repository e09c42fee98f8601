/* Motor and load on an elastic shaft. The bearing of the load is not settable.
 *
 * title: Motor and load on an elastic shaft
 * inner: 0.001
 * input: torque 0.0 N.m air gap torque
 * state: motor.phi 0.0 rad angle of the motor
 * state: motor.w 0.0 rad/s speed of the motor
 * state: load.phi 0.0 rad angle of the load
 * state: load.w 0.0 rad/s speed of the load
 * shown: motor.phi motor.w load.phi
 * parameter: motor.J 0.01 kg.m2 0.05 inertia of the motor
 * parameter: load.J 0.03 kg.m2 0.1 inertia of the load
 * parameter: shaft.c 40.0 N.m/rad 0.1 stiffness of the shaft
 * parameter: shaft.d 0.1 N.m.s/rad 0.1 damping of the shaft
 * parameter: motor.b 0.02 N.m.s/rad 0.1 bearing of the motor
 */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double motor = p[0], load = p[1], stiffness = p[2], material = p[3], rub_motor = p[4], rub_load = 0.03;
    const double shaft = stiffness * (x[0] - x[2]) + material * (x[1] - x[3]);
    dx[0] = x[1];
    dx[1] = (u[0] - shaft - rub_motor * x[1]) / motor;
    dx[2] = x[3];
    dx[3] = (shaft - rub_load * x[3]) / load;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
