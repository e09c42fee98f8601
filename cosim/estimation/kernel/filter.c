/* Extended Kalman filter over a log; the model's functions and step.c stand above this text.
 *
 * The mean of all states runs by RK4, or by the method for stiff equations, whose transition then takes the place of the series; the covariance is that of the stochastic states S only, for the
 * others (lags driven by known commands) are known. Measurements are independent and taken one at a time:
 *   P = Phi P Phi' + Q dt,   Phi = (I + hA + (hA)^2/2 + (hA)^3/6)^substeps
 *   e = y - g(x),  s = C P C' + r,  K = P C'/s,  x += K e,  P -= K s K'
 * A reading that is older than its row by a part of it is held against g(x) at that time: on a cubic over the substep, by the
 * model's rates at both ends, or straight over the step if the equations are stiff. So is what a sensor with a lag sees.
 */
/* Two columns at once; many entries of a Jacobian are zero. */
typedef double Two __attribute__((vector_size(16), aligned(8), may_alias));

static void multiply(const double *a, const double *b, double *out)
{
    for (int i = 0; i < NS; i++) {
        Two row[NS / 2 + 1] = {{0.0}};
        double last = 0.0;
        for (int k = 0; k < NS; k++) {
            const double factor = a[NS * i + k], *of = b + NS * k;
            if (factor == 0.0) continue;
            for (int j = 0; j < NS / 2; j++) row[j] += factor * *(const Two *)(of + 2 * j);
            if (NS % 2) last += factor * of[NS - 1];
        }
        for (int j = 0; j < NS / 2; j++) *(Two *)(out + NS * i + 2 * j) = row[j];
        if (NS % 2) out[NS * i + NS - 1] = last;
    }
}

static void add_times(double factor, const double *of, double *to)
{
    for (int j = 0; j < NS / 2; j++) *(Two *)(to + 2 * j) += factor * *(const Two *)(of + 2 * j);
    if (NS % 2) to[NS - 1] += factor * of[NS - 1];
}

/* A row of P -= PC PC'/s, symmetric to the last bit. */
static void subtract_outer(double first, const double *PC, double inverse, double *to)
{
    for (int j = 0; j < NS / 2; j++) *(Two *)(to + 2 * j) -= first * *(const Two *)(PC + 2 * j) * inverse;
    if (NS % 2) to[NS - 1] -= first * PC[NS - 1] * inverse;
}

/* P = Phi P Phi'. No measurement reduces an asymmetry by rounding, so that it would grow without bound where the plant is
 * unstable. */
static void propagate(const double *Phi, double *P)
{
    double M[NS * NS + 1], turned[NS * NS + 1];
    multiply(Phi, P, M);
    for (int i = 0; i < NS; i++)
        for (int j = 0; j < NS; j++) turned[NS * j + i] = M[NS * i + j];
    multiply(Phi, turned, P); /* P is symmetric, and Phi has zeros */
    for (int i = 0; i < NS; i++)
        for (int j = 0; j < i; j++) P[NS * i + j] = P[NS * j + i] = 0.5 * (P[NS * i + j] + P[NS * j + i]);
}

#if STIFF
static void linear(const void *of, double t, double share, const double *x, double *k)
{
    const double *A = of;
    (void)t, (void)share;
    for (int i = 0; i < NS; i++) {
        k[i] = 0.0;
        for (int j = 0; j < NS; j++) k[i] += A[NS * i + j] * x[j];
    }
}

/* The columns of Phi are what the integrator makes of the unit vectors. */
static void transition(double h, const double *A, double *Phi)
{
    Factored factored;
    const int singular = factor(NS, h, A, &factored);
    for (int j = 0; j < NS; j++) {
        double x[NS + 1] = {0.0};
        x[j] = singular ? NAN : 1.0;
        stiff_step(NS, &factored, 0.0, h, x, linear, A);
        for (int i = 0; i < NS; i++) Phi[NS * i + j] = x[i];
    }
}
#else
/* out = I + factor a */
static void add_identity(double factor, const double *a, double *out)
{
    for (int i = 0; i < NS * NS; i++) out[i] = factor * a[i];
    for (int i = 0; i < NS; i++) out[(NS + 1) * i] += 1.0;
}

/* Horner's rule, with the zeros of A in each product. */
static void transition(double h, const double *A, double *Phi)
{
    double next[NS * NS + 1];
    add_identity(h / 3.0, A, Phi);
    multiply(A, Phi, next);
    add_identity(h / 2.0, next, Phi);
    multiply(A, Phi, next);
    add_identity(h, next, Phi);
}
#endif

/* Over a whole step: the series is good for a substep, its power for the step. */
static void transition_over(int substeps, double h, const double *A, double *Phi)
{
    double once[NS * NS + 1], next[NS * NS + 1];
    transition(h, A, once);
    memcpy(Phi, once, sizeof(double) * NS * NS);
    for (int s = 1; s < substeps; s++) {
        multiply(once, Phi, next);
        memcpy(Phi, next, sizeof(double) * NS * NS);
    }
}

/* Outputs along a step, for readings of the past.
 *   late     part of a row by which each reading is older than its row
 *   begin    outputs at the start of the step; `at` and `rate`: at the start of a substep
 *   read     outputs at the times of their readings
 *   lagged   response of a sensor with a lag to what an output has changed by since the start of the step */
typedef struct {
    const double *late;
    double begin[NY], at[NY], rate[NY], read[NY], lagged[NY];
} Path;

#if STIFF
static void path_begin(Path *path, const double *y) { memcpy(path->begin, y, sizeof path->begin); }

static void path_end(Path *path, const Lags *lags, const double *y)
{
    for (int j = 0; j < NY; j++) {
        path->read[j] = y[j] - (path->late ? path->late[j] * (y[j] - path->begin[j]) : 0.0);
        path->lagged[j] = lags->alpha[j] * (y[j] - path->begin[j]);
    }
}
#else
#define RATE_STEP 1e-3 /* of differences, as a share of a substep */

/* Change of the outputs y over a substep at the model's present rates. */
static void output_rates(double t, double h, const double *x, const double *u, const double *command, const double *p, const double *y, double *rate)
{
    double slope[NX + 1], moved[NX + 1];
    deriv(t, x, u, p, slope);
    for (int i = 0; i < NX; i++) moved[i] = x[i] + RATE_STEP * h * slope[i];
    measure(t + RATE_STEP * h, moved, command, p, rate);
    for (int j = 0; j < NY; j++) rate[j] = (rate[j] - y[j]) / RATE_STEP;
}

static void path_begin(Path *path, const double *y)
{
    memcpy(path->begin, y, sizeof path->begin);
    memcpy(path->at, y, sizeof path->at);
    memset(path->lagged, 0, sizeof path->lagged);
}

/* After substep s of n, with outputs y and rates at its end. */
static void path_over(Path *path, const Lags *lags, const Log *log, int s, const double *y, const double *rate)
{
    const int n = log->substeps;
    for (int j = 0; j < NY; j++) {
        const double change = y[j] - path->at[j], early = path->rate[j] - change, ending = rate[j] - change;
        const double at = path->late ? (1.0 - path->late[j]) * n - s : 1.0; /* of the reading, in substeps */
        if (at >= 1.0) path->read[j] = y[j] + (at - 1.0) * rate[j];
        else if (at >= 0.0) path->read[j] = path->at[j] + at * change + at * (1.0 - at) * (early * (1.0 - at) - ending * at);
        if (lags->on[j]) {
            double alpha, beta, phi, w[2];
            lag_weights(log->lags[j] * n, &alpha, &beta, &phi);
            bend_weights(log->lags[j] * n, w, w + 1);
            path->lagged[j] = phi * path->lagged[j] + beta * (path->at[j] - path->begin[j]) + alpha * (y[j] - path->begin[j])
                + w[0] * early - w[1] * ending;
        }
        path->at[j] = y[j];
    }
}
#endif

/* r, errors and variances: rows x NY, of each measurement, the last two before it is taken (NaN where missing); states: rows x NX,
 * filtered; covariances: rows x NS x NS, theirs. */
int filter(const Log *log, const double *p, const double *x0, const double *P0, const double *q, const double *r,
           double *errors, double *variances, double *states, double *memories, double *covariances)
{
    static const int S[NS + 1] = STOCHASTIC;
    double x[NX + 1], P[NS * NS + 1], A[NS * NS + 1], Phi[NS * NS + 1], C[NY * NS + 1], y[NY];
    double u[3 * NU], command[NU], memory[NM + 1] = {0.0}, moved[NS + 1];
    double slopes[NY * NS + 1]; /* of the outputs, where C holds those of the readings */
    Lags lags = lags_of(log);
    const int has_past = log->late || lags.any;
    Path path = {0};
    const double h = log->step / log->substeps;
    const double delay = DELAY < 0 ? 0.0 : p[DELAY < 0 ? 0 : DELAY] / log->step;
    memcpy(x, x0, sizeof(double) * NX);
    memcpy(P, P0, sizeof(double) * NS * NS);
    for (int k = 0; k < log->rows; k++) {
        double t = log->start + k * log->step;
        if (k > 0) {
            double before = t - log->step;
            if (has_past) {
                row_command(log, k - 1, command); /* acts over the step: an output that takes a command does not jump within it */
                measure(before, x, command, p, y);
                path.late = log->late ? log->late + NY * k : NULL;
                path_begin(&path, y);
            }
            for (int s = 0; s < log->substeps; s++) {
                act(log, k, s, delay, memory, p, u);
                if (s == 0 && k <= log->settle) memcpy(P, P0, sizeof(double) * NS * NS); /* lags still forget their start */
                else if (s == 0) {
                    jacobian(before, x, u, p, A);
                    transition_over(log->substeps, h, A, Phi);
                    if (lags.any) lags_over_step(&lags, Phi);
                    propagate(Phi, P);
                    for (int i = 0; i < NS; i++) P[(NS + 1) * i] += q[i] * log->step;
                }
#if !STIFF
                if (has_past) output_rates(before + s * h, h, x, u, command, p, path.at, path.rate);
#endif
                substep(before + s * h, h, x, u, p);
#if !STIFF
                if (has_past) {
                    double rate[NY + 1];
                    measure(before + (s + 1) * h, x, command, p, y);
                    output_rates(before + (s + 1) * h, h, x, u + 2 * NU, command, p, y, rate);
                    path_over(&path, &lags, log, s, y, rate);
                }
#endif
            }
        }
        row_command(log, k, command);
        measure(t, x, command, p, y);
        if (has_past && k > 0) {
#if STIFF
            path_end(&path, &lags, y);
#endif
            for (int j = 0; j < NY; j++) {
                if (lags.on[j]) lags.m[j] += path.lagged[j] - lags.alpha[j] * (y[j] - path.begin[j]);
                if (log->late) y[j] = path.read[j];
            }
        }
        measure_jacobian(t, x, command, p, C);
        if (lags.any) {
            if (k <= log->settle) lags_begin(&lags, log, k == 0, y, C, P);
            memcpy(slopes, C, sizeof C);
            lags_at_row(&lags, y, C);
        }
        for (int i = 0; i < NS; i++) moved[i] = 0.0; /* what the measurements of this row have moved the state by */
        for (int j = 0; j < NY; j++) {
            double measured = log->y[NY * k + j];
            errors[NY * k + j] = variances[NY * k + j] = NAN;
            if (isnan(measured)) continue;
            double s = r[NY * k + j], e = measured - y[j], PC[NS + 1] = {0.0};
            const double *c = C + NS * j;
            for (int l = 0; l < NS; l++) {
                if (c[l] == 0.0) continue;
                add_times(c[l], P + NS * l, PC); /* P is symmetric */
                e -= c[l] * moved[l];
            }
            if (lags.any) s += lags_join(&lags, j, C, PC);
            if (lags.on[j]) e -= lags.moved[j];
            for (int l = 0; l < NS; l++) if (c[l] != 0.0) s += c[l] * PC[l];
            errors[NY * k + j] = e;
            variances[NY * k + j] = s;
            if (lags.any) lags_update(&lags, PC, e, s);
            const double inverse = 1.0 / s; /* a division is dear */
            for (int i = 0; i < NS; i++) {
                moved[i] += PC[i] * e * inverse;
                subtract_outer(PC[i], PC, inverse, P + NS * i);
            }
        }
        for (int i = 0; i < NS; i++) x[S[i]] += moved[i];
        if (lags.any) {
            measure(t, x, command, p, y);
            lags_after(&lags, y, slopes, P);
        }
        if (states) memcpy(states + NX * k, x, sizeof(double) * NX);
        if (memories) memcpy(memories + NM * k, memory, sizeof(double) * NM);
        if (covariances) memcpy(covariances + NS * NS * k, P, sizeof(double) * NS * NS);
        for (int i = 0; i < NX; i++) if (!isfinite(x[i])) return k;
    }
    return log->rows;
}
