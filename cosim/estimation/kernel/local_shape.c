/* Local shapes of unnamed terms (generate.py), of z with coefficients c: a step, KNOTS bumps, sine and cosine. */

static int is_absent(const double *c)
{
    for (int k = 0; k < KNOTS + 3; k++) if (c[k] != 0.0) return 0;
    return 1;
}

static double local_shape(double z, const double *c)
{
    if (is_absent(c)) return 0.0;
    double sum = 0.0;
    if (c[0] != 0.0) {
        const double at = fmin(fmax(z, -1.0), 1.0);
        sum = c[0] * (2.0 + 3.0 * at - at * at * at) / 4.0;
    }
    for (int k = 0; k < KNOTS; k++) {
        const double over = 1.0 - (z - k) * (z - k) / 4.0;
        if (over > 0.0) sum += c[1 + k] * over * over * over;
    }
    if (c[KNOTS + 1] != 0.0) sum += c[KNOTS + 1] * sin(z);
    if (c[KNOTS + 2] != 0.0) sum += c[KNOTS + 2] * cos(z);
    return sum;
}

/* Derivative of the shape by z. */
static double local_slope(double z, const double *c)
{
    if (is_absent(c)) return 0.0;
    double sum = fabs(z) < 1.0 ? c[0] * 0.75 * (1.0 - z * z) : 0.0;
    for (int k = 0; k < KNOTS; k++) {
        const double over = 1.0 - (z - k) * (z - k) / 4.0;
        if (over > 0.0) sum -= c[1 + k] * 1.5 * over * over * (z - k);
    }
    if (c[KNOTS + 1] != 0.0) sum += c[KNOTS + 1] * cos(z);
    if (c[KNOTS + 2] != 0.0) sum -= c[KNOTS + 2] * sin(z);
    return sum;
}
