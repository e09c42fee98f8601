/* Cart on a spring with a hanging pendulum. */
static void rates(const double *p, double t, const double *x, const double *u, double *dx) {
    const double cart = p[0], bob = p[1], length = p[2], spring = p[3], rub = p[4], hinge = p[5], g = 9.81;
    const double s = sin(x[2]), c = cos(x[2]), m11 = cart + bob, m12 = bob * length * c, m22 = bob * length * length;
    const double push = u[0] - spring * x[0] - rub * x[1] + bob * length * s * x[3] * x[3];
    const double turn = -bob * g * length * s - hinge * x[3], det = m11 * m22 - m12 * m12;
    dx[0] = x[1];
    dx[1] = (m22 * push - m12 * turn) / det;
    dx[2] = x[3];
    dx[3] = (m11 * turn - m12 * push) / det;
}
static void readings(const double *p, double t, const double *x, const double *u, double *y) {}
