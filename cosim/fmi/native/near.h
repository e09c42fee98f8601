/* sin, cos and powers near a known point, by series. A substep evaluates the equations four times, and their arguments hardly
 * move in between. An argument that has moved too far goes to the C library and becomes the known point. The error of the
 * series is below 1e-14 for sin and cos, and below 3e-14 of a power. Each substep begins without known points. */
#ifndef NEAR_H
#define NEAR_H

#include <math.h>

#define MOST_TURN 0.03125    /* [rad] a further term of sin: MOST_TURN^7/7! = 6e-15 */
#define MOST_GROWTH 0.015625 /* of (|exponent| + 5)·r; a further term of the power: MOST_GROWTH^6/6! = 2e-14 */

/* An angle, its sine and its cosine; or a base, 1/base, the power and the exponent. */
typedef struct {
    double at, first, second, exponent;
} Near;

static inline void forget_all(Near *near, int count)
{
    for (int k = 0; k < count; k++) near[k] = (Near){HUGE_VAL, 0.0, 0.0, 0.0};
}

static inline void near_angle(Near *near, double angle, double *sine, double *cosine)
{
    const double d = angle - near->at, dd = d * d;
    if (!(fabs(d) < MOST_TURN)) {
        near->at = angle;
        *sine = near->first = sin(angle);
        *cosine = near->second = cos(angle);
        return;
    }
    /* sin(a + d) = sin a + (cos a·sin d - sin a·(1 - cos d)), and so for cos */
    const double turn = d + d * dd * (-1.0 / 6.0 + dd * (1.0 / 120.0));
    const double fall = dd * (0.5 + dd * (-1.0 / 24.0 + dd * (1.0 / 720.0)));
    *sine = near->first + (near->second * turn - near->first * fall);
    *cosine = near->second - (near->first * turn + near->second * fall);
}

static inline double near_power(Near *near, double base, double e)
{
    const double r = (base - near->at) * near->first;
    if (!(fabs(r) * (fabs(e) + 5.0) < MOST_GROWTH && e == near->exponent)) {
        near->at = base;
        near->first = 1.0 / base;
        near->exponent = e;
        return near->second = pow(base, e);
    }
    /* (1 + r)^e - 1, the binomial series */
    const double third = 1.0 + (e - 3.0) * (1.0 / 4.0) * r * (1.0 + (e - 4.0) * (1.0 / 5.0) * r);
    const double growth = e * r * (1.0 + (e - 1.0) * (1.0 / 2.0) * r * (1.0 + (e - 2.0) * (1.0 / 3.0) * r * third));
    return near->second + near->second * growth;
}

#endif
