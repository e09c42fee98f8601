/* An unknown addition to each output of a free run, in place of a filter over states.
 *
 * Each addition d is a Gauss-Markov process, which a Kalman filter estimates from the readings: d' = -d/T + w. The last NS states
 * are these additions, in the order of the outputs. */
static __thread const double *run_outputs, *run_states, *run_memories;

/* Called before each filter, with the free run at the same parameters: rows x NY, rows x NX, rows x NM. */
void use_run(const double *outputs, const double *states, const double *memories)
{
    run_outputs = outputs;
    run_states = states;
    run_memories = memories;
}

int filter(const Log *log, const double *p, const double *x0, const double *P0, const double *q, const double *r,
           double *errors, double *variances, double *states, double *memories, double *covariances)
{
    double d[NS + 1] = {0.0}, P[NS + 1], before[NY];
    const double fades = exp(-log->step / p[LASTING]);
    (void)x0;
    for (int j = 0; j < NS; j++) P[j] = P0[(NS + 1) * j];
    Lags lags = lags_of(log);
    for (int k = 0; k < log->rows; k++) {
        double y[NY];
        for (int j = 0; j < NY; j++) {
            const double true_output = run_outputs[NY * k + j];
            if (!isfinite(true_output)) return k;
            if (!lags.on[j]) {
                y[j] = true_output;
                continue;
            }
            if (k == 0) lags.m[j] = (1.0 - lags.alpha[j]) * true_output;
            y[j] = lags.m[j] + lags.alpha[j] * true_output;
            lags.m[j] = lags.phi[j] * y[j] + lags.beta[j] * true_output;
        }
        for (int j = 0; j < NS && k; j++) {
            d[j] *= fades;
            P[j] = k <= log->settle ? P0[(NS + 1) * j] : fades * fades * P[j] + q[j] * log->step;
        }
        for (int j = 0; j < NY; j++) {
            const double measured = log->y[NY * k + j], part = log->late && k ? log->late[NY * k + j] : 0.0;
            errors[NY * k + j] = variances[NY * k + j] = NAN;
            if (isnan(measured)) continue;
            const double late = part != 0.0 ? part * (y[j] - before[j]) : 0.0;
            const double e = measured - (y[j] - late) - d[j], s = P[j] + r[NY * k + j];
            errors[NY * k + j] = e;
            variances[NY * k + j] = s;
            d[j] += P[j] * e / s;
            P[j] -= P[j] * P[j] / s;
        }
        memcpy(before, y, sizeof y);
        if (states) {
            memcpy(states + NX * k, run_states + NX * k, sizeof(double) * NX);
            memcpy(states + NX * k + NB, d, sizeof(double) * NS);
        }
        if (memories) memcpy(memories + NM * k, run_memories + NM * k, sizeof(double) * NM);
        if (covariances)
            for (int i = 0; i < NS; i++)
                for (int j = 0; j < NS; j++) covariances[NS * NS * k + NS * i + j] = i == j ? P[j] : 0.0;
    }
    return log->rows;
}
