/* Sensors with a lag. The reading l of an output y follows T l' = y - l, for y straight from row to row:
 *   l = m + alpha y at a row;  m = phi l + beta y after it;  phi = exp(-h/T)
 * m stands beside the stochastic states, with a covariance M of its own and X between m and the states. What a bent way of y
 * from row to row adds to l is added to m. */
typedef struct {
    int any, on[NY];
    double alpha[NY], beta[NY], phi[NY], m[NY], X[NY][NS + 1], M[NY][NY], PC[NY], moved[NY];
} Lags;

static void lag_weights(double rows, double *alpha, double *beta, double *phi)
{
    *phi = exp(-1.0 / rows);
    *alpha = 1.0 - rows * (1.0 - *phi);
    *beta = rows * (1.0 - *phi) - *phi;
}

#define LONG 30.0 /* rows from which a lag weighs all parts of a row alike */

/* Response of a lag at the end of a row to the bends s^2(1-s) and s(1-s)^2 of an output, s from 1 back to 0 along the row. */
static void bend_weights(double rows, double *early, double *late)
{
    *early = *late = 1.0 / (12.0 * rows);
    if (rows > LONG) return;
    const double phi = exp(-1.0 / rows), first = rows * (1.0 - phi) - phi; /* moments of the weight exp(-s/rows)/rows */
    const double second = 2.0 * rows * first - phi, third = 3.0 * rows * second - phi;
    *early = second - third;
    *late = first - 2.0 * second + third;
}

static Lags lags_of(const Log *log)
{
    Lags of = {0};
    for (int j = 0; j < NY && log->lags; j++) {
        of.on[j] = log->lags[j] > 0.0;
        of.any |= of.on[j];
        if (of.on[j]) lag_weights(log->lags[j], of.alpha + j, of.beta + j, of.phi + j);
    }
    return of;
}

static double along(const double *a, const double *b)
{
    double sum = 0.0;
    for (int i = 0; i < NS; i++) sum += a[i] * b[i];
    return sum;
}

static void times_row(const double *P, const double *row, double *out)
{
    for (int i = 0; i < NS; i++) out[i] = along(P + NS * i, row);
}

/* The sensor begins at y, uncertain by what the readings change over a time constant. */
static void lags_begin(Lags *of, const Log *log, int first, const double *y, const double *C, const double *P)
{
    for (int j = 0; j < NY; j++) {
        if (!of->on[j]) continue;
        if (first) of->m[j] = (1.0 - of->alpha[j]) * y[j];
        times_row(P, C + NS * j, of->X[j]);
        for (int i = 0; i < NS; i++) of->X[j][i] *= 1.0 - of->alpha[j];
    }
    for (int j = 0; j < NY; j++)
        for (int i = 0; i < NY && of->on[j]; i++)
            if (of->on[i]) of->M[i][j] = (1.0 - of->alpha[i]) * along(C + NS * i, of->X[j]);
    for (int j = 0; j < NY; j++) {
        if (!of->on[j]) continue;
        int over = log->lags[j] < 1.0 ? 1 : log->lags[j] > log->rows - 1 ? log->rows - 1 : (int)(log->lags[j] + 0.5);
        double change = over > 0 ? (log->y[NY * over + j] - log->y[j]) * log->lags[j] / over : 0.0;
        if (isfinite(change)) of->M[j][j] += change * change;
    }
}

/* From states and outputs to readings. */
static void lags_at_row(const Lags *of, double *y, double *C)
{
    for (int j = 0; j < NY; j++) {
        if (!of->on[j]) continue;
        y[j] = of->m[j] + of->alpha[j] * y[j];
        for (int i = 0; i < NS; i++) C[NS * j + i] *= of->alpha[j];
    }
}

/* Add the part of m to the covariance PC of the states with reading j; return its part of the reading's variance. */
static double lags_join(Lags *of, int j, const double *C, double *PC)
{
    for (int i = 0; i < NY; i++) of->PC[i] = of->on[i] ? along(of->X[i], C + NS * j) + (of->on[j] ? of->M[i][j] : 0.0) : 0.0;
    if (!of->on[j]) return 0.0;
    for (int i = 0; i < NS; i++) PC[i] += of->X[j][i];
    return of->PC[j];
}

static void lags_update(Lags *of, const double *PC, double e, double s)
{
    for (int i = 0; i < NY; i++) {
        of->moved[i] += of->PC[i] * e / s;
        for (int l = 0; l < NS; l++) of->X[i][l] -= of->PC[i] * PC[l] / s;
        for (int l = 0; l < NY; l++) of->M[i][l] -= of->PC[i] * of->PC[l] / s;
    }
}

/* y and C: outputs and their slopes at the updated state. */
static void lags_after(Lags *of, const double *y, const double *C, const double *P)
{
    double gain[NY], PC[NY][NS + 1], M[NY][NY];
    for (int j = 0; j < NY; j++) {
        gain[j] = of->beta[j] + of->phi[j] * of->alpha[j];
        times_row(P, C + NS * j, PC[j]);
    }
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++)
            M[i][j] = of->phi[i] * of->phi[j] * of->M[i][j] + of->phi[i] * gain[j] * along(C + NS * j, of->X[i])
                + gain[i] * of->phi[j] * along(C + NS * i, of->X[j]) + gain[i] * gain[j] * along(C + NS * i, PC[j]);
    memcpy(of->M, M, sizeof M);
    for (int j = 0; j < NY; j++) {
        for (int i = 0; i < NS; i++) of->X[j][i] = of->phi[j] * of->X[j][i] + gain[j] * PC[j][i];
        of->m[j] = of->phi[j] * (of->m[j] + of->moved[j]) + gain[j] * y[j];
        of->moved[j] = 0.0;
    }
}

static void lags_over_step(Lags *of, const double *Phi)
{
    double moved[NS + 1];
    for (int j = 0; j < NY; j++) {
        if (!of->on[j]) continue;
        times_row(Phi, of->X[j], moved);
        memcpy(of->X[j], moved, sizeof(double) * NS);
    }
}
