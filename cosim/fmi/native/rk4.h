/* The classical Runge-Kutta method, the same for a filter, a native FMU and the lanes of a sweep.
 *
 * Defined above this text: SHAPE of an array that holds a state, EACH of its elements, and AT, which is one of them;
 * RATES(t, moment, x, k), which writes the derivative at the start, the middle or the end of the step (moment 0, 1, 2); and
 * ARGUMENTS, all that RATES takes. */
KIND void rk4(double t, double h, ARGUMENTS)
{
    double k1 SHAPE, k2 SHAPE, k3 SHAPE, k4 SHAPE, z SHAPE;
    const double half = 0.5 * h, sixth = h / 6.0;
    RATES(t, 0, x, k1);
    EACH z AT = x AT + half * k1 AT;
    RATES(t + half, 1, z, k2);
    EACH z AT = x AT + half * k2 AT;
    RATES(t + half, 1, z, k3);
    EACH z AT = x AT + h * k3 AT;
    RATES(t + h, 2, z, k4);
    EACH x AT += sixth * (k1 AT + 2.0 * (k2 AT + k3 AT) + k4 AT);
}
