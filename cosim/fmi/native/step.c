/* A model on the commands of a log: what acts after delay and shaping, substeps, outputs row by row. The same for every
 * model; NX, NU, NY, NM and DELAY and the model's functions deriv, measure and shape_all stand above this text. */
#include <math.h>
#include <string.h>

typedef struct {
    int rows, substeps;
    int settle;           /* rows over which a filter's covariance stays as it began */
    double step, start;
    const double *u;      /* rows x NU */
    const double *y;      /* rows x NY, NaN where missing */
    const int *ramps;     /* NU: whether an input runs straight from row to row, or is held */
    const double *late;   /* rows x NY: part of a row by which readings are older than theirs; NULL: by none */
    const double *lags;   /* NY: time constants of the sensors in rows; NULL: no lags */
} Log;

static const double *row_of(const Log *log, int row)
{
    return log->u + NU * (row < 0 ? 0 : row >= log->rows ? log->rows - 1 : row);
}

/* Mean over [t0, t1] (in rows from the start) of the held commands, delayed; the first row has always been there. */
static void held_mean(const Log *log, double t0, double t1, double *out)
{
    for (int j = 0; j < NU; j++) out[j] = 0.0;
    double at = t0;
    while (at < t1 - 1e-12) {
        int row = (int)floor(at + 1e-9);
        double until = row + 1.0 < t1 ? row + 1.0 : t1;
        const double *u = row_of(log, row);
        for (int j = 0; j < NU; j++) out[j] += u[j] * (until - at) / (t1 - t0);
        at = until;
    }
}

/* What is interpolated, at a time (in rows from the start); the others stay as they are. */
static void on_ramps(const Log *log, double at, double *out)
{
    int row = (int)floor(at + 1e-9);
    const double *before = row_of(log, row), *after = row_of(log, row + 1);
    for (int j = 0; j < NU; j++) if (log->ramps[j]) out[j] = before[j] + (at - row) * (after[j] - before[j]);
}

/* Commands (3 x NU) act at the start, the middle and the end of a substep. */
#if STEPPED
static void substep(double t, double h, double *x, const double *u, const double *p)
{
    step_library(t, h, x, u + NU, p);
}
#elif STIFF
#define MOST NX
#include "stiff.h"

typedef struct {
    const double *u, *p;
} Acting;

/* Between its three values a command runs on a parabola. */
static void rates_of(const void *of, double t, double share, const double *x, double *k)
{
    const Acting *acting = of;
    double u[NU + 1];
    for (int j = 0; j < NU; j++) {
        const double start = acting->u[j], middle = acting->u[NU + j] - start, end = acting->u[2 * NU + j] - start;
        u[j] = start + share * (4.0 * middle - end + share * (2.0 * end - 4.0 * middle));
    }
    deriv(t, x, u, acting->p, k);
}

static void substep(double t, double h, double *x, const double *u, const double *p)
{
    const Acting acting = {u, p};
    double J[NX * NX + 1];
    Factored factored;
    state_jacobian(t, x, u, p, J);
    if (factor(NX, h, J, &factored)) x[0] = NAN;
    else stiff_step(NX, &factored, t, h, x, rates_of, &acting);
}
#else
#define KIND static
#define SHAPE [NX + 1]
#define EACH for (int i = 0; i < NX; i++)
#define AT [i]
#define ARGUMENTS double *x, const double *u, const double *p
#define RATES(t, moment, x, k) deriv(t, x, u + (moment) * NU, p, k)
#include "rk4.h"

static void substep(double t, double h, double *x, const double *u, const double *p)
{
    rk4(t, h, x, u, p);
#ifdef NB
    complete_library(t + h, x, u + 2 * NU, p);
#endif
}
#endif

/* The commands with which the FMU gives its outputs in row k: those of the row, which act from there on. */
static void row_command(const Log *log, int k, double *u)
{
    memcpy(u, row_of(log, k), sizeof(double) * NU);
    on_ramps(log, k, u);
}

/* What acts at the start, the middle and the end (u: 3 x NU) of substep s of the step that ends in row k: the log's command after
 * delay and everything that shapes it; what remembers takes one step, with the command in the middle. */
static void act(const Log *log, int k, int s, double delay, double *memory, const double *p, double *u)
{
    double shaped[NU + NM + 1], length = log->step / log->substeps, from = k - 1 + (double)s / log->substeps, width = 1.0 / log->substeps, *middle = u + NU;
    int ramps = 0;
    for (int j = 0; j < NU; j++) ramps |= log->ramps[j];
    if (delay > 0.0) held_mean(log, from - delay, from + width - delay, middle);
    else memcpy(middle, log->u + NU * (k - 1), sizeof(double) * NU);
    for (int i = 0; i < 3; i += 2) {
        double *at = u + i * NU;
        memcpy(at, middle, sizeof(double) * NU);
        if (ramps) {
            on_ramps(log, from + 0.5 * i * width - delay, at);
            shape_all(length, at, memory, p, shaped);
            memcpy(at, shaped, sizeof(double) * NU);
        }
    }
    if (ramps) on_ramps(log, from + 0.5 * width - delay, middle);
    shape_all(length, middle, memory, p, shaped);
    memcpy(middle, shaped, sizeof(double) * NU);
    memcpy(memory, shaped + NU, sizeof(double) * NM);
    if (!ramps) for (int i = 0; i < 3; i += 2) memcpy(u + i * NU, middle, sizeof(double) * NU);
}

/* Run without looking at measurements: kicks (rows x NX) are added to the state at each row, outputs (rows x NY) are free of
 * noise. `first` is the row of x0 and memory0: the log's rows before it matter to a delay alone. Results begin with it. */
static int run_from(const Log *log, int first, const double *p, const double *x0, const double *memory0, const double *kicks,
                    double *outputs, double *states, double *memories)
{
    double x[NX + 1], u[3 * NU], command[NU], memory[NM + 1];
    const double h = log->step / log->substeps, delay = DELAY < 0 ? 0.0 : p[DELAY < 0 ? 0 : DELAY] / log->step;
    memcpy(x, x0, sizeof(double) * NX);
    memcpy(memory, memory0, sizeof(double) * NM);
    for (int k = first; k < log->rows; k++) {
        double t = log->start + k * log->step;
#if STEPPED
        if (k == first) {
            row_command(log, k, command);
            if (begin_library(t, x, command, p) > MOST_STATUS) x[0] = NAN;
        }
#endif
        if (k > first) {
            for (int s = 0; s < log->substeps; s++) {
                act(log, k, s, delay, memory, p, u);
                substep(t - log->step + s * h, h, x, u, p);
            }
            if (kicks) for (int i = 0; i < NX; i++) x[i] += kicks[NX * k + i];
        }
        row_command(log, k, command);
        measure(t, x, command, p, outputs + NY * (k - first));
        memcpy(states + NX * (k - first), x, sizeof(double) * NX);
        if (NM) memcpy(memories + NM * (k - first), memory, sizeof(double) * NM);
        for (int i = 0; i < NX; i++) if (!isfinite(x[i])) return k;
    }
    return log->rows;
}

/* The same, with results in the rows of the log. */
int simulate(const Log *log, int first, const double *p, const double *x0, const double *memory0, const double *kicks,
             double *outputs, double *states, double *memories)
{
    return run_from(log, first, p, x0, memory0, kicks, outputs + NY * first, states + NX * first, memories + NM * first);
}

/* Run `length` rows beyond each of some rows; x0 (count x NX) and memory0 (count x NM) are of these. */
void simulate_from(const Log *log, int count, const int *rows, int length, const double *p, const double *x0,
                   const double *memory0, double *outputs, double *states, double *memories)
{
    for (int i = 0, n = length + 1; i < count; i++) {
        Log part = *log;
        if (rows[i] + n < log->rows) part.rows = rows[i] + n;
        run_from(&part, rows[i], p, x0 + NX * i, memory0 + NM * i, NULL, outputs + NY * n * i, states + NX * n * i,
                 memories + NM * n * i);
    }
}
