/* Two pendulums joined by a torsion spring. */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double J1 = p[0], J2 = p[1], c1 = p[2], c2 = p[3], k = p[4], d1 = p[5], d2 = p[6];
    const double through = k * (x[0] - x[2]);
    dx[0] = x[1];
    dx[1] = (u[0] - c1 * sin(x[0]) - d1 * x[1] - through) / J1;
    dx[2] = x[3];
    dx[3] = (through - c2 * sin(x[2]) - d2 * x[3]) / J2;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
