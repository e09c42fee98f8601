/* Two pendulums joined by a torsion spring.
 *
 * title: Two pendulums joined by a torsion spring
 * inner: 0.004
 * input: torque 0.0 N.m torque on the first
 * state: phi1 0.0 rad angle of the first
 * state: w1 0.0 rad/s rate of the first
 * state: phi2 0.0 rad angle of the second
 * state: w2 0.0 rad/s rate of the second
 * shown: phi1 phi2
 * parameter: J1 0.1 kg.m2 0.03 inertia of the first
 * parameter: J2 0.08 kg.m2 0.03 inertia of the second
 * parameter: c1 1.0 N.m/rad 0.03 torque of gravity on the first per sine of its angle
 * parameter: c2 0.8 N.m/rad 0.03 torque of gravity on the second per sine of its angle
 * parameter: k 1.0 N.m/rad 0.03 stiffness of the spring
 * parameter: d1 0.03 N.m.s/rad 0.1 viscous friction of the first
 * parameter: d2 0.02 N.m.s/rad 0.1 viscous friction of the second
 */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double J1 = p[0], J2 = p[1], c1 = p[2], c2 = p[3], k = p[4], d1 = p[5], d2 = p[6];
    const double through = k * (x[0] - x[2]);
    dx[0] = x[1];
    dx[1] = (u[0] - c1 * sin(x[0]) - d1 * x[1] - through) / J1;
    dx[2] = x[3];
    dx[3] = (through - c2 * sin(x[2]) - d2 * x[3]) / J2;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
