/* Cart on a spring with a hanging pendulum.
 *
 * title: Cart on a spring with a hanging pendulum
 * inner: 0.004
 * input: force 0.0 N force on the cart
 * state: x 0.0 m position of the cart
 * state: v 0.0 m/s velocity of the cart
 * state: phi 0.0 rad angle of the pendulum, 0 when hanging
 * state: w 0.0 rad/s rate of the pendulum
 * shown: x v phi w
 * parameter: cart 1.0 kg 0.05 mass of the cart
 * parameter: bob 0.25 kg 0.05 mass of the bob
 * parameter: length 0.5 m 0.02 from hinge to bob
 * parameter: spring 3.0 N/m 0.05 stiffness that centres the cart
 * parameter: rub 0.8 N.s/m 0.1 viscous friction of the cart
 * parameter: hinge 0.005 N.m.s/rad 0.1 viscous friction of the hinge
 */
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
