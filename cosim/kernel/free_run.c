/* An unknown addition to each output of a free run, and unknown start states, in place of a filter over states.
 *
 * Each addition d is a Gauss-Markov process, d' = -d/T + w. A change z of a start state changes the outputs by its slopes times z.
 * A Kalman filter estimates both from the readings. The last NS states are the additions, in the order of the outputs, and the start
 * states. */
#define NK (NS - NY)
static __thread const double *run_outputs, *run_states, *run_memories, *run_slopes;

/* Called before each filter, with the free run at the same parameters: rows x NY, rows x NX, rows x NM, rows x NY x NK. */
void use_run(const double *outputs, const double *states, const double *memories, const double *slopes)
{
    run_outputs = outputs;
    run_states = states;
    run_memories = memories;
    run_slopes = slopes;
}

/* Reading of a sensor with a lag, and its memory m after the row. */
static double lag_over_row(const Lags *lags, int j, double *m, double value)
{
    const double reading = *m + lags->alpha[j] * value;
    *m = lags->phi[j] * reading + lags->beta[j] * value;
    return reading;
}

/* The next reading, for one that is younger than its row: the run is known there. */
static double following(const Lags *lags, const Log *log, int k, int j)
{
    const double value = run_outputs[NY * (k + 1 < log->rows ? k + 1 : k) + j];
    return lags->on[j] ? lags->m[j] + lags->alpha[j] * value : value;
}

int filter(const Log *log, const double *p, const double *x0, const double *P0, const double *q, const double *r,
           double *errors, double *variances, double *states, double *memories, double *covariances)
{
    double z[NS + 1] = {0.0}, P[NS * NS + 1], before[NY], kept[NY][NK + 1];
    const double fades = exp(-log->step / p[LASTING]);
    memcpy(P, P0, sizeof(double) * NS * NS);
    Lags lags = lags_of(log);
    for (int k = 0; k < log->rows; k++) {
        double y[NY];
        for (int j = 0; j < NY; j++) {
            y[j] = run_outputs[NY * k + j];
            if (!isfinite(y[j])) return k;
            if (!lags.on[j]) continue;
            if (k == 0) lags.m[j] = (1.0 - lags.alpha[j]) * y[j];
            y[j] = lag_over_row(&lags, j, lags.m + j, y[j]);
        }
        if (k > 0 && k <= log->settle) memcpy(P, P0, sizeof(double) * NS * NS);
        for (int j = 0; j < NY && k; j++) {
            z[j] *= fades;
            if (k <= log->settle) continue;
            for (int i = 0; i < NS; i++) P[NS * j + i] *= fades;
            for (int i = 0; i < NS; i++) P[NS * i + j] *= fades;
            P[(NS + 1) * j] += q[j] * log->step;
        }
        for (int j = 0; j < NY; j++) {
            const double measured = log->y[NY * k + j], age = log->late ? log->late[NY * k + j] : 0.0;
            const double part = k == 0 && age > 0.0 ? 0.0 : age;
            double slopes[NK + 1], PH[NS + 1];
            for (int i = 0; i < NK; i++) {
                slopes[i] = run_slopes[NK * (NY * k + j) + i];
                if (!lags.on[j]) continue;
                if (k == 0) kept[j][i] = (1.0 - lags.alpha[j]) * slopes[i];
                slopes[i] = lag_over_row(&lags, j, kept[j] + i, slopes[i]);
            }
            errors[NY * k + j] = variances[NY * k + j] = NAN;
            if (isnan(measured)) continue;
            const double late = part == 0.0 ? 0.0 : part * (part > 0.0 ? y[j] - before[j] : following(&lags, log, k, j) - y[j]);
            double e = measured - (y[j] - late) - z[j], s = r[NY * k + j];
            for (int l = 0; l < NS; l++) {
                PH[l] = P[NS * l + j];
                for (int i = 0; i < NK; i++) PH[l] += P[NS * l + NY + i] * slopes[i];
            }
            s += PH[j];
            for (int i = 0; i < NK; i++) {
                e -= slopes[i] * z[NY + i];
                s += slopes[i] * PH[NY + i];
            }
            errors[NY * k + j] = e;
            variances[NY * k + j] = s;
            for (int l = 0; l < NS; l++) z[l] += PH[l] * e / s;
            for (int l = 0; l < NS; l++)
                for (int i = 0; i <= l; i++) P[NS * i + l] = P[NS * l + i] -= PH[l] * PH[i] / s;
        }
        memcpy(before, y, sizeof y);
        if (states) {
            memcpy(states + NX * k, run_states + NX * k, sizeof(double) * NX);
            for (int i = 0; i < NS; i++) states[NX * k + NB + i] = z[i] + (i < NY ? 0.0 : x0[NB + i]);
        }
        if (memories) memcpy(memories + NM * k, run_memories + NM * k, sizeof(double) * NM);
        if (covariances) memcpy(covariances + NS * NS * k, P, sizeof(double) * NS * NS);
    }
    return log->rows;
}
