/* Motor and load on an elastic shaft. The bearing of the load is not settable. */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double motor = p[0], load = p[1], stiffness = p[2], material = p[3], rub_motor = p[4], rub_load = 0.03;
    const double shaft = stiffness * (x[0] - x[2]) + material * (x[1] - x[3]);
    dx[0] = x[1];
    dx[1] = (u[0] - shaft - rub_motor * x[1]) / motor;
    dx[2] = x[3];
    dx[3] = (shaft - rub_load * x[3]) / load;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
