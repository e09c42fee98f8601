/* Two tanks joined by a pipe, a pump into each, an outlet from the right one.
 *
 * title: Two tanks joined by a pipe
 * inner: 0.5
 * input: pump_left 5.0 V voltage of the left pump
 * input: pump_right 5.0 V voltage of the right pump
 * state: left.h 0.3 m level in the left tank
 * state: right.h 0.25 m level in the right tank
 * output: gauge_left 0.3 m level that is shown
 * output: gauge_right 0.25 m level that is shown
 * parameter: left.area 0.02 m2 0.02 cross section
 * parameter: right.area 0.02 m2 0.02 cross section
 * parameter: pipe.k 0.00012 m2.5/s 0.1 flow through the pipe at 1 m
 * parameter: outlet.k 0.00012 m2.5/s 0.1 flow out of the right tank at 1 m
 * parameter: gain_left 6e-06 m3/(s.V) 0.05 flow of the left pump
 * parameter: gain_right 6e-06 m3/(s.V) 0.05 flow of the right pump
 */
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
