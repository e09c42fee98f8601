/* A model of equations stepped for many runs at once: RK4 substeps as in its FMU, inputs held; W runs side by side, so that
 * a compiler makes vectors of them. Printed above this text: W, NX, NU, NY, NP; below `LANES`, deriv and measure. */
#include <math.h>

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
/* A division that a branch would have kept from being made gives infinity, which is not taken: nothing traps. */
#pragma GCC optimize ("no-trapping-math")
/* By names of ours: of its own sin and cos of one angle the compiler makes one call, of which there is no vector. */
#define VECTOR(name) __asm__(#name) __attribute__((simd("notinbranch"), const))
extern double lane_sin(double) VECTOR(sin);
extern double lane_cos(double) VECTOR(cos);
extern double lane_exp(double) VECTOR(exp);
extern double lane_pow(double, double) VECTOR(pow);
#define sin lane_sin
#define cos lane_cos
#define exp lane_exp
#define pow lane_pow
#if __GLIBC_PREREQ(2, 35)
extern double lane_tanh(double) VECTOR(tanh);
#define tanh lane_tanh
#endif
#define CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define CLONES
#endif
#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

typedef const double (*Lanes)[W];

/* A branch whose sides are both computed. */
INLINE double chosen(int condition, double then, double otherwise)
{
    return condition ? then : otherwise;
}

/* Those of C look for values that are no numbers, in no vector. */
INLINE double larger(double a, double b)
{
    return a > b ? a : b;
}

INLINE double smaller(double a, double b)
{
    return a < b ? a : b;
}

#define fmax larger
#define fmin smaller

/*LANES*/

#define KIND INLINE
#define SHAPE [NX][W]
#define EACH for (int j = 0; j < NX; j++) for (int i = 0; i < W; i++)
#define AT [j][i]
#define ARGUMENTS double (*restrict x)[W], Lanes u, Lanes p
#define RATES(t, moment, x, k) deriv(t, (Lanes)(x), u, p, k)
#include "rk4.h"

#define LOAD(to, from, rows) for (int j = 0; j < (rows); j++) for (int i = 0; i < W; i++) to[j][i] = from[j * runs + b + i]

/* `count` substeps of `h` from `t`, then the outputs at `end` where y is not NULL; runs is a multiple of W.
 * x: NX x runs, u: NU x runs, p: NP x runs, y: NY x runs */
CLONES void steps(long runs, double t, double h, int count, double end, double *x, const double *u, const double *p, double *y)
{
    for (long b = 0; b < runs; b += W) {
        double X[NX + 1][W], U[NU + 1][W], P[NP + 1][W], Y[NY + 1][W];
        LOAD(X, x, NX);
        LOAD(U, u, NU);
        LOAD(P, p, NP);
        for (int k = 0; k < count; k++) rk4(t + k * h, h, X, (Lanes)U, (Lanes)P);
        for (int j = 0; j < NX; j++) for (int i = 0; i < W; i++) x[j * runs + b + i] = X[j][i];
        if (!y) continue;
        measure(end, (Lanes)X, (Lanes)U, (Lanes)P, Y);
        for (int j = 0; j < NY; j++) for (int i = 0; i < W; i++) y[j * runs + b + i] = Y[j][i];
    }
}
