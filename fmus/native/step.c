/* A model on the commands of a log: what acts after delay and shaping, RK4 substeps, outputs row by row. The same for every
 * model; NX, NU, NY, NM and DELAY and the model's functions deriv, measure and shape_all stand above this text. */
#include <math.h>
#include <string.h>

typedef struct {
    int rows, substeps;
    int settle;           /* rows over which a filter's covariance stays as it began */
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
