/* DC motor with a load torque. */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double resistance = p[0], inductance = p[1], constant = p[2], inertia = p[3], damping = p[4];
    dx[0] = (u[0] - resistance * x[0] - constant * x[2]) / inductance;
    dx[1] = x[2];
    dx[2] = (constant * x[0] - damping * x[2] - u[1]) / inertia;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
