/* Hydraulic cylinder with a valve, against a spring and a force; piston area 1e-3 m2, chambers of 5e-4 m3 at x = 0.
 *
 * title: Hydraulic cylinder with a valve
 * inner: 0.0005
 * input: valve 0.0 1 opening of the valve
 * input: load 0.0 N force against the piston
 * state: piston.x 0.0 m position of the piston
 * state: piston.v 0.0 m/s velocity of the piston
 * state: p_a 1000000.0 Pa pressure in chamber A
 * state: p_b 1000000.0 Pa pressure in chamber B
 * shown: piston.x piston.v p_a p_b
 * parameter: mass 50.0 kg 0.05 moved mass
 * parameter: damping 800.0 N.s/m 0.1 viscous friction
 * parameter: spring 15000.0 N/m 0.05 stiffness of the load
 * parameter: bulk 200000000.0 Pa 0.1 bulk modulus of the oil
 * parameter: valve.k 2e-07 m4/(s.N.5) 0.05 flow of the open valve at 1 Pa
 * parameter: supply 2000000.0 Pa 0.03 supply pressure
 */
static double orifice(double k, double fall) { return k * fall / sqrt(sqrt(fall * fall + 4e8)); }
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double mass = p[0], damping = p[1], spring = p[2], bulk = p[3], valve = p[4], supply = p[5], area = 1e-3;
    const double open = valve * (u[0] > 0 ? u[0] : 0), shut = valve * (u[0] < 0 ? -u[0] : 0);
    const double into_a = orifice(open, supply - x[2]) - orifice(shut, x[2]);
    const double into_b = orifice(shut, supply - x[3]) - orifice(open, x[3]);
    dx[0] = x[1];
    dx[1] = (area * (x[2] - x[3]) - damping * x[1] - spring * x[0] - u[1]) / mass;
    dx[2] = bulk / (5e-4 + area * x[0]) * (into_a - area * x[1]);
    dx[3] = bulk / (5e-4 - area * x[0]) * (into_b + area * x[1]);
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
