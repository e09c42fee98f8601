/* Heater and air in a box that loses heat to the room. */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double flow = p[3] * (x[0] - x[1]);
    dx[0] = (p[0] * u[0] - flow) / p[1];
    dx[1] = (flow - p[4] * (x[1] - u[1])) / p[2];
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
