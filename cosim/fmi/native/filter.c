/* A controller that samples: Kalman filter, state feedback, saturation.
 *
 *   x̂ = F·x̂ + G·u,   P = F·P·F' + V
 *   K = P·H'/(H·P·H' + W),   x̂ += K·(z − H·x̂),   P = (I − K·H)·P·(I − K·H)' + K·W·K'
 *   u = sat(−L·(x̂ − x_ref), ±limit)
 * and, where a fix has come since the last sample, a second update with it, one row of it after the other.
 *
 * Printed above this text: design(m, &d), which fills the matrices from the parameters; measured, fixed, reference,
 * start and publish, which say which variables they are.
 * What is kept: x̂, P, u, the last fix, then the matrices, so that a step computes none of them anew. */
#include "model.h"

typedef struct {
    double x[NX], P[NX][NX], u[NU], fix;
    Design d;
} Filter;

static Filter *filter_of(Instance *m)
{
    return (Filter *)(void *)m->own;
}

/* out = a·b of square matrices; out is neither of them. */
static void product(int n, const double *a, const double *b, double *out)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            double s = 0.0;
            for (int k = 0; k < n; k++) s += a[i * n + k] * b[k * n + j];
            out[i * n + j] = s;
        }
}

/* exp of a matrix by its series, after halving it until it is small, and squaring as often. */
static void exponential(int n, double *a)
{
    double norm = 0.0, term[EXP_SIZE * EXP_SIZE], sum[EXP_SIZE * EXP_SIZE], next[EXP_SIZE * EXP_SIZE];
    for (int i = 0; i < n; i++) {
        double row = 0.0;
        for (int j = 0; j < n; j++) row += fabs(a[i * n + j]);
        norm = row > norm ? row : norm;
    }
    int halved = 0;
    for (; norm > 1.0 && halved < 1000; norm *= 0.5) halved++;
    for (int k = 0; k < n * n; k++) a[k] = ldexp(a[k], -halved);
    for (int k = 0; k < n * n; k++) sum[k] = term[k] = k % (n + 1) == 0 ? 1.0 : 0.0;
    for (int order = 1; order <= 22; order++) {
        product(n, term, a, next);
        for (int k = 0; k < n * n; k++) sum[k] += term[k] = next[k] / order;
    }
    for (; halved > 0; halved--) {
        product(n, sum, sum, next);
        memcpy(sum, next, sizeof(double) * (size_t)(n * n));
    }
    memcpy(a, sum, sizeof(double) * (size_t)(n * n));
}

/* F and G of inputs held over dt, exact: [F G; 0 I] = exp(dt·[A B; 0 0]). */
static void hold(double dt, double A[NX][NX], double B[NX][NU], double F[NX][NX], double G[NX][NU])
{
    double block[EXP_SIZE * EXP_SIZE] = {0};
    const int n = NX + NU;
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++) block[i * n + j] = dt * A[i][j];
        for (int j = 0; j < NU; j++) block[i * n + NX + j] = dt * B[i][j];
    }
    exponential(n, block);
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++) F[i][j] = block[i * n + j];
        for (int j = 0; j < NU; j++) G[i][j] = block[i * n + NX + j];
    }
}

/* The inverse of a matrix of NZ by NZ, by elimination with pivots; 1 where there is none. */
static int inverse(double a[NZ][NZ], double out[NZ][NZ])
{
    for (int i = 0; i < NZ; i++) for (int j = 0; j < NZ; j++) out[i][j] = i == j ? 1.0 : 0.0;
    for (int c = 0; c < NZ; c++) {
        int pivot = c;
        for (int i = c + 1; i < NZ; i++) if (fabs(a[i][c]) > fabs(a[pivot][c])) pivot = i;
        if (!(fabs(a[pivot][c]) > 0.0)) return 1;
        for (int j = 0; j < NZ; j++) {
            double s = a[c][j]; a[c][j] = a[pivot][j]; a[pivot][j] = s;
            s = out[c][j]; out[c][j] = out[pivot][j]; out[pivot][j] = s;
        }
        const double scale = 1.0 / a[c][c];
        for (int j = 0; j < NZ; j++) a[c][j] *= scale, out[c][j] *= scale;
        for (int i = 0; i < NZ; i++) {
            if (i == c) continue;
            const double f = a[i][c];
            for (int j = 0; j < NZ; j++) a[i][j] -= f * a[c][j], out[i][j] -= f * out[c][j];
        }
    }
    return 0;
}

/* P = M·P·M' */
static void carry(Filter *f, const double *M)
{
    double MP[NX][NX];
    product(NX, M, &f->P[0][0], &MP[0][0]);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            double s = 0.0;
            for (int k = 0; k < NX; k++) s += MP[i][k] * M[j * NX + k];
            f->P[i][j] = s;
        }
}

static void predict(Filter *f)
{
    const Design *d = &f->d;
    double x[NX];
    for (int i = 0; i < NX; i++) {
        double own = 0.0, forced = 0.0;
        for (int j = 0; j < NX; j++) own += d->F[i][j] * f->x[j];
        for (int j = 0; j < NU; j++) forced += d->G[i][j] * f->u[j];
        x[i] = own + forced;
    }
    memcpy(f->x, x, sizeof x);
    carry(f, &d->F[0][0]);
    for (int i = 0; i < NX; i++) f->P[i][i] += d->V[i];
}

static int correct(Instance *m, Filter *f, const double *z)
{
    const Design *d = &f->d;
    double PH[NX][NZ], S[NZ][NZ], SI[NZ][NZ], K[NX][NZ], left[NX][NX], y[NZ];
    for (int i = 0; i < NZ; i++) {
        y[i] = z[i];
        for (int j = 0; j < NX; j++) y[i] -= d->H[i][j] * f->x[j];
    }
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NZ; j++) {
            PH[i][j] = 0.0;
            for (int k = 0; k < NX; k++) PH[i][j] += f->P[i][k] * d->H[j][k];
        }
    for (int i = 0; i < NZ; i++)
        for (int j = 0; j < NZ; j++) {
            S[i][j] = i == j ? d->W[i] : 0.0;
            for (int k = 0; k < NX; k++) S[i][j] += d->H[i][k] * PH[k][j];
        }
    if (inverse(S, SI)) return refuse(m, "the variance of the innovation is 0; a measurement variance of 0 needs process noise");
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NZ; j++) {
            K[i][j] = 0.0;
            for (int k = 0; k < NZ; k++) K[i][j] += PH[i][k] * SI[k][j];
        }
    for (int i = 0; i < NX; i++) {
        double s = 0.0;
        for (int j = 0; j < NZ; j++) s += K[i][j] * y[j];
        f->x[i] += s;
    }
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            left[i][j] = i == j ? 1.0 : 0.0;
            for (int k = 0; k < NZ; k++) left[i][j] -= K[i][k] * d->H[k][j];
        }
    carry(f, &left[0][0]);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            double noise = 0.0;
            for (int k = 0; k < NZ; k++) noise += K[i][k] * d->W[k] * K[j][k];
            f->P[i][j] += noise;
        }
    return 0;
}

/* One row of a fix: its noise does not depend on that of another. */
static int correct_by(Instance *m, Filter *f, double z, const double *H, double W)
{
    double PH[NX], K[NX], left[NX][NX], S = W, y = z;
    for (int i = 0; i < NX; i++) {
        y -= H[i] * f->x[i];
        PH[i] = 0.0;
        for (int k = 0; k < NX; k++) PH[i] += f->P[i][k] * H[k];
    }
    for (int i = 0; i < NX; i++) S += H[i] * PH[i];
    if (!(fabs(S) > 0.0)) return refuse(m, "the variance of a fix is 0; a measurement variance of 0 needs process noise");
    for (int i = 0; i < NX; i++) K[i] = PH[i] / S;
    for (int i = 0; i < NX; i++) f->x[i] += K[i] * y;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) left[i][j] = (i == j ? 1.0 : 0.0) - K[i] * H[j];
    carry(f, &left[0][0]);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) f->P[i][j] += K[i] * W * K[j];
    return 0;
}

static int correct_by_fix(Instance *m, Filter *f)
{
    double z[NF];
    const double fix = fixed(m, z);
    if (fix == f->fix) return 0;
    f->fix = fix;
    for (int i = 0; i < NF; i++)
        if (correct_by(m, f, z[i], f->d.fix_H[i], f->d.fix_W[i])) return 1;
    return 0;
}

static void feed_back(Instance *m, Filter *f)
{
    double wanted[NX];
    reference(m, wanted);
    for (int i = 0; i < NU; i++) {
        double s = 0.0;
        for (int j = 0; j < NX; j++) s += f->d.L[i][j] * (f->x[j] - wanted[j]);
        f->u[i] = fmin(fmax(-s, -f->d.limit), f->d.limit) + 0.0; /* -0.0 is 0.0 */
    }
}

static int write_outputs(Instance *m)
{
    double y[OUTPUTS];
    Filter *f = filter_of(m);
    double variance[NX];
    for (int i = 0; i < NX; i++) variance[i] = f->P[i][i];
    publish(m, f->u, f->x, variance, y);
    for (int k = 0; k < OUTPUTS; k++)
        if (!isfinite(y[k])) return refuse(m, "%s is %g", variables[INPUTS + k].name, y[k]);
    memcpy(m->values + INPUTS, y, sizeof y);
    m->is_stale = 0;
    return 0;
}

static int initialize(Instance *m)
{
    Filter *f = filter_of(m);
    if (check_bounds(m)) return 1;
    memset(f, 0, sizeof *f);
    if (design(m, &f->d)) return 1;
    double z[NF];
    f->fix = fixed(m, z);
    start(m, f->x);
    feed_back(m, f);
    m->time = m->start_time;
    return write_outputs(m);
}

static int advance(Instance *m, double t, double h)
{
    Filter *f = filter_of(m);
    const double sample = f->d.sample;
    double z[NZ];
    if (fabs(h - sample) > 1e-6 * sample)
        return refuse(m, "step of %.15g s; the controller is sampled at %.15g s (parameter %s)", h, sample, SAMPLE_NAME);
    measured(m, z);
    predict(f);
    if (correct(m, f, z) || correct_by_fix(m, f)) return 1;
    feed_back(m, f);
    m->time = t + h;
    return write_outputs(m);
}

static int refresh_outputs(Instance *m)
{
    return write_outputs(m);
}

static void after_restore(Instance *m)
{
    (void)m;
}
