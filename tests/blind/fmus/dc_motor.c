/* DC motor with a load torque.
 *
 * title: DC motor with load torque
 * inner: 0.001
 * input: voltage 0.0 V terminal voltage
 * input: load_torque 0.0 N.m torque that brakes
 * state: current 0.0 A armature current
 * state: angle 0.0 rad angle of the shaft
 * state: speed 0.0 rad/s speed of the shaft
 * shown: current angle speed
 * parameter: resistance 1.2 ohm 0.1 of the winding
 * parameter: inductance 0.006 H 0.1 of the winding
 * parameter: constant 0.05 N.m/A 0.03 torque constant
 * parameter: inertia 0.0002 kg.m2 0.05 moment of inertia
 * parameter: damping 0.0001 N.m.s/rad 0.1 viscous friction
 */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double resistance = p[0], inductance = p[1], constant = p[2], inertia = p[3], damping = p[4];
    dx[0] = (u[0] - resistance * x[0] - constant * x[2]) / inductance;
    dx[1] = x[2];
    dx[2] = (constant * x[0] - damping * x[2] - u[1]) / inertia;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
