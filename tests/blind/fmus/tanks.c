/* Two tanks joined by a pipe, a pump into each, an outlet from the right one. */
static double through(double k, double fall) { return k * fall / sqrt(sqrt(fall * fall + 1e-4)); }
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double across = through(p[2], x[0] - x[1]);
    dx[0] = (p[4] * u[0] - across) / p[0];
    dx[1] = (p[5] * u[1] + across - through(p[3], x[1])) / p[1];
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {
    y[0] = x[0];
    y[1] = x[1];
}
