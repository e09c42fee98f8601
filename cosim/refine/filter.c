/* Extended Kalman filter over a log; the model's functions stand above this text.
 *
 * The mean of all states runs by RK4 with the command held; the covariance is that of the stochastic states S only, for the
 * others (lags driven by known commands) are known. Measurements are independent and taken one at a time:
 *   P = Phi P Phi' + Q dt,   Phi = (I + hA + (hA)^2/2 + (hA)^3/6)^substeps
 *   e = y - g(x),  s = C P C' + r,  K = P C'/s,  x += K e,  P -= K s K'
 */
#include <math.h>
#include <string.h>

typedef struct {
    int rows, substeps;
    double step, start;
    const double *u;      /* rows x NU, held from row to row */
    const double *y;      /* rows x NY, NaN where missing */
} Log;

/* Mean over [t0, t1] (in rows from the start) of the held commands, delayed; the first row has always been there. */
static void held_mean(const Log *log, double t0, double t1, double *out)
{
    for (int j = 0; j < NU; j++) out[j] = 0.0;
    double at = t0;
    while (at < t1 - 1e-12) {
        int row = (int)floor(at + 1e-9);
        double until = row + 1.0 < t1 ? row + 1.0 : t1;
        const double *u = log->u + NU * (row < 0 ? 0 : row >= log->rows ? log->rows - 1 : row);
        for (int j = 0; j < NU; j++) out[j] += u[j] * (until - at) / (t1 - t0);
        at = until;
    }
}

static void rk4(double t, double h, double *x, const double *u, const double *p)
{
    double k1[NX], k2[NX], k3[NX], k4[NX], z[NX];
    deriv(t, x, u, p, k1);
    for (int i = 0; i < NX; i++) z[i] = x[i] + 0.5 * h * k1[i];
    deriv(t + 0.5 * h, z, u, p, k2);
    for (int i = 0; i < NX; i++) z[i] = x[i] + 0.5 * h * k2[i];
    deriv(t + 0.5 * h, z, u, p, k3);
    for (int i = 0; i < NX; i++) z[i] = x[i] + h * k3[i];
    deriv(t + h, z, u, p, k4);
    for (int i = 0; i < NX; i++) x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
}

static void multiply(const double *a, const double *b, double *out, int transpose_b)
{
    for (int i = 0; i < NS; i++)
        for (int j = 0; j < NS; j++) {
            double sum = 0.0;
            for (int k = 0; k < NS; k++) sum += a[NS * i + k] * (transpose_b ? b[NS * j + k] : b[NS * k + j]);
            out[NS * i + j] = sum;
        }
}

static void transition(double h, const double *A, double *Phi)
{
    double term[NS * NS], next[NS * NS];
    for (int i = 0; i < NS * NS; i++) Phi[i] = term[i] = (i % (NS + 1) == 0);
    for (int order = 1; order <= 3; order++) {
        multiply(term, A, next, 0);
        for (int i = 0; i < NS * NS; i++) Phi[i] += term[i] = next[i] * h / order;
    }
}

/* The command held over the step that ends in row k, with which the FMU gives its outputs there. */
static const double *held(const Log *log, int k) { return log->u + NU * (k > 0 ? k - 1 : 0); }

/* What acts over substep s of the step that ends in row k: the log's command after delay and everything that shapes it. */
static void act(const Log *log, int k, int s, double delay, double *memory, const double *p, double *u)
{
    double shaped[NU + NM + 1], from = k - 1 + (double)s / log->substeps;
    if (delay > 0.0) held_mean(log, from - delay, from + 1.0 / log->substeps - delay, u);
    else memcpy(u, log->u + NU * (k - 1), sizeof(double) * NU);
    shape_all(u, memory, p, shaped);
    memcpy(u, shaped, sizeof(double) * NU);
    memcpy(memory, shaped + NU, sizeof(double) * NM);
}

/* Run without looking at measurements: kicks (rows x NX) are added to the state at each row, outputs (rows x NY) are free of
 * noise. `first` is the row of x0 and memory0: the log's rows before it matter to a delay alone. */
int simulate(const Log *log, int first, const double *p, const double *x0, const double *memory0, const double *kicks,
             double *outputs, double *states, double *memories)
{
    double x[NX], u[NU], memory[NM + 1];
    const double h = log->step / log->substeps, delay = DELAY < 0 ? 0.0 : p[DELAY < 0 ? 0 : DELAY] / log->step;
    memcpy(x, x0, sizeof x);
    memcpy(memory, memory0, sizeof(double) * NM);
    for (int k = first; k < log->rows; k++) {
        double t = log->start + k * log->step;
        if (k > first) {
            for (int s = 0; s < log->substeps; s++) {
                act(log, k, s, delay, memory, p, u);
                rk4(t - log->step + s * h, h, x, u, p);
            }
            if (kicks) for (int i = 0; i < NX; i++) x[i] += kicks[NX * k + i];
        }
        measure(t, x, held(log, k), p, outputs + NY * k);
        if (states) memcpy(states + NX * k, x, sizeof x);
        if (memories) memcpy(memories + NM * k, memory, sizeof(double) * NM);
        for (int i = 0; i < NX; i++) if (!isfinite(x[i])) return k;
    }
    return log->rows;
}

/* Over a whole step: the series is good for a substep, its power for the step. */
static void transition_over(int substeps, double h, const double *A, double *Phi)
{
    double once[NS * NS], next[NS * NS];
    transition(h, A, once);
    memcpy(Phi, once, sizeof once);
    for (int s = 1; s < substeps; s++) {
        multiply(once, Phi, next, 0);
        memcpy(Phi, next, sizeof next);
    }
}

/* errors and variances: rows x NY, of each measurement before it is taken (NaN where missing); states: rows x NX, filtered. */
int filter(const Log *log, const double *p, const double *x0, const double *P0, const double *q, const double *r,
           double *errors, double *variances, double *states, double *memories)
{
    static const int S[NS] = STOCHASTIC;
    double x[NX], P[NS * NS], A[NS * NS], Phi[NS * NS], M[NS * NS], C[NY * NS], y[NY], u[NU];
    double memory[NM + 1] = {0.0}, moved[NS];
    const double h = log->step / log->substeps;
    const double delay = DELAY < 0 ? 0.0 : p[DELAY < 0 ? 0 : DELAY] / log->step;
    memcpy(x, x0, sizeof x);
    memcpy(P, P0, sizeof P);
    for (int k = 0; k < log->rows; k++) {
        double t = log->start + k * log->step;
        if (k > 0) {
            double before = t - log->step;
            for (int s = 0; s < log->substeps; s++) {
                act(log, k, s, delay, memory, p, u);
                if (s == 0 && k <= SETTLE / log->step) memcpy(P, P0, sizeof P); /* the lags still forget their start */
                else if (s == 0) {
                    jacobian(before, x, u, p, A);
                    transition_over(log->substeps, h, A, Phi);
                    multiply(Phi, P, M, 0);
                    multiply(M, Phi, P, 1);
                    for (int i = 0; i < NS; i++) P[(NS + 1) * i] += q[i] * log->step;
                }
                rk4(before + s * h, h, x, u, p);
            }
        }
        measure(t, x, held(log, k), p, y);
        measure_jacobian(t, x, held(log, k), p, C);
        for (int i = 0; i < NS; i++) moved[i] = 0.0; /* what the measurements of this row have moved the state by */
        for (int j = 0; j < NY; j++) {
            double measured = log->y[NY * k + j];
            errors[NY * k + j] = variances[NY * k + j] = NAN;
            if (isnan(measured)) continue;
            double PC[NS], s = r[j], e = measured - y[j];
            for (int i = 0; i < NS; i++) {
                PC[i] = 0.0;
                for (int l = 0; l < NS; l++) PC[i] += P[NS * i + l] * C[NS * j + l];
            }
            for (int i = 0; i < NS; i++) {
                s += C[NS * j + i] * PC[i];
                e -= C[NS * j + i] * moved[i];
            }
            errors[NY * k + j] = e;
            variances[NY * k + j] = s;
            for (int i = 0; i < NS; i++) {
                moved[i] += PC[i] * e / s;
                for (int l = 0; l < NS; l++) P[NS * i + l] -= PC[i] * PC[l] / s;
            }
        }
        for (int i = 0; i < NS; i++) x[S[i]] += moved[i];
        if (states) memcpy(states + NX * k, x, sizeof x);
        if (memories) memcpy(memories + NM * k, memory, sizeof(double) * NM);
        for (int i = 0; i < NX; i++) if (!isfinite(x[i])) return k;
    }
    return log->rows;
}
