/* Unknown deviations of the outputs of a free run, and unknown start states, in place of a filter over states.
 *
 * The deviations d of the outputs go on from row to row as those by start states do, and an unknown input w of each drives them:
 *   d+ = Phi d + Psi d- + h (w + c),  w a Gauss-Markov process, w' = -w/T + noise
 * The deviations d- of the row before stand for hidden states, such as velocities. Without these, Psi is 0 and d- is left out. A
 * change z of a start state changes the outputs by its slopes times z. A Kalman filter estimates all from the readings. The last
 * NS states are d-, w, d, all in the order of the outputs, and the start states. Unnamed terms c, if any, depend on the outputs as
 * estimated up to the row, and on their rates, of which the covariance knows nothing. */
#define NW NY
#define ND (2 * NY)
#define NZ (3 * NY)
#define NK (NS - NZ)
static __thread double *run_outputs, *run_states, *run_memories;
static __thread const double *run_bends, *run_slopes, *run_propagation;
static __thread int run_follows;

/* Called before each filter, with the free run at the same parameters: rows x NY twice, rows x NX, rows x NM, rows x NY x NK, and
 * Phi beside Psi, NY x 2 NY. A bend is the distance of an output, halfway over the step that ends in a row, from the straight line.
 * A run that follows is made again by the filter, row by row, with forces along positions where the filter sees the machine: unknown
 * inputs move a free run away for good, and forces would act at wrong places. */
void use_run(double *outputs, const double *bends, double *states, double *memories, const double *slopes,
             const double *propagation, int follows)
{
    run_follows = follows;
    run_outputs = outputs;
    run_bends = bends;
    run_states = states;
    run_memories = memories;
    run_slopes = slopes;
    run_propagation = propagation;
}

static int has_hidden(void)
{
    for (int j = 0; j < NY; j++)
        for (int l = NY; l < 2 * NY; l++)
            if (run_propagation[2 * NY * j + l] != 0.0) return 1;
    return 0;
}

/* Rows d-, w and d of the transition times a matrix, whose columns before `first` are left out. */
static void go_on(double *a, int first, int count, int hidden, double fades, double h)
{
    double moved[NY][NS + 1];
    for (int j = 0; j < NY; j++) {
        const double *now = run_propagation + 2 * NY * j, *before = now + NY;
        for (int i = first; i < count; i++) moved[j][i] = h * a[count * (NW + j) + i];
        for (int l = 0; l < NY; l++)
            for (int i = first; i < count; i++) moved[j][i] += now[l] * a[count * (ND + l) + i];
        for (int l = 0; hidden && l < NY; l++)
            for (int i = first; i < count; i++) moved[j][i] += before[l] * a[count * l + i];
    }
    for (int j = 0; j < NY; j++)
        for (int i = first; i < count; i++) {
            if (hidden) a[count * j + i] = a[count * (ND + j) + i];
            a[count * (NW + j) + i] *= fades;
            a[count * (ND + j) + i] = moved[j][i];
        }
}

static void transposed(double *a)
{
    for (int i = 0; i < NS; i++)
        for (int j = 0; j < i; j++) {
            const double other = a[NS * i + j];
            a[NS * i + j] = a[NS * j + i];
            a[NS * j + i] = other;
        }
}

/* Reading of a sensor with a lag, and its memory m after the row. */
static double lag_over_row(const Lags *lags, int j, double *m, double value)
{
    const double reading = *m + lags->alpha[j] * value;
    *m = lags->phi[j] * reading + lags->beta[j] * value;
    return reading;
}

/* Output of the run at a time before (age > 0) or after row k, on a parabola over the step. */
static double run_at(const Log *log, int k, int j, double age)
{
    const int row = age > 0.0 ? k : k + 1;
    if (row < 1 || row >= log->rows || age == 0.0) return run_outputs[NY * k + j];
    const double *y = run_outputs + NY * row + j, share = age > 0.0 ? 1.0 - age : -age;
    return y[-NY] + share * (y[0] - y[-NY]) + 4.0 * share * (1.0 - share) * run_bends[NY * row + j];
}

/* Reading of a sensor with a lag at that time, on a straight line between its readings; m after row k. */
static double lagged_at(const Lags *lags, const Log *log, int k, int j, double age, double now, double before, double bent)
{
    if (age >= 0.0) return now - age * (now - before);
    const int next = NY * (k + 1 < log->rows ? k + 1 : k) + j;
    return now - age * (lags->m[j] + bent * run_bends[next] + lags->alpha[j] * run_outputs[next] - now);
}

/* Continue the run to row k, with the library; z and slopes tell where the machine is at the row before. */
static void follow(const Log *log, int k, const double *p, const double *z, double *x, double *memory)
{
    static const int read_places[] = READ_PLACES, run_places[] = RUN_PLACES;
    const double h = log->step / log->substeps, delay = DELAY < 0 ? 0.0 : p[DELAY < 0 ? 0 : DELAY] / log->step;
    double u[3 * NU + 1], command[NU + 1], t = log->start + k * log->step;
    if (k == 0) {
        row_command(log, k, command);
        if (begin_library(t, x, command, p) > MOST_STATUS) x[0] = NAN;
    } else {
        for (int l = 0; l < POSITIONS; l++) {
            const int j = read_places[l];
            double by = z[ND + j];
            for (int i = 0; i < NK; i++) by += run_slopes[NK * (NY * (k - 1) + j) + i] * z[NZ + i];
            moved_by[run_places[l]] = by;
        }
        is_moved = 1;
        for (int s = 0; s < log->substeps; s++) {
            act(log, k, s, delay, memory, p, u);
            substep(t - log->step + s * h, h, x, u, p);
        }
        row_command(log, k, command); /* the outputs of a row are those to its command */
        if (!isnan(x[0]) && begin_library(t, x, command, p) > MOST_STATUS) x[0] = NAN;
        is_moved = 0;
    }
    row_command(log, k, command);
    measure(t, x, command, p, run_outputs + NY * k);
    memcpy(run_states + NX * k, x, sizeof(double) * NX);
    memcpy(run_memories + NM * k, memory, sizeof(double) * NM);
}

#if UNNAMED
/* Unnamed terms in row k; known: the outputs there and their rates, which become those of the row. */
static void unnamed_terms(const Log *log, int k, const double *p, const double *z, double *known, double *out)
{
    for (int j = 0; j < NY; j++) {
        double now = run_outputs[NY * k + j] + z[ND + j];
        for (int i = 0; i < NK; i++) now += run_slopes[NK * (NY * k + j) + i] * z[NZ + i];
        known[NY + j] = k > 0 ? (now - known[j]) / log->step : 0.0;
        known[j] = now;
    }
    add_unnamed(log->start + k * log->step, known, log->u + NU * k, p, out); /* the command from the row on */
}
#endif

int filter(const Log *log, const double *p, const double *x0, const double *P0, const double *q, const double *r,
           double *errors, double *variances, double *states, double *memories, double *covariances)
{
    double z[NS + 1] = {0.0}, P[NS * NS + 1], before[NY], kept[NY][NK + 1], bent[NY] = {0.0};
    const double fades = exp(-log->step / p[LASTING]);
    const int hidden = has_hidden(), first = hidden ? 0 : NW;
    double x[NX + 1], memory[NM + 1] = {0.0};
#if UNNAMED
    double known[2 * NY] = {0.0}, unnamed[NY];
#endif
    memcpy(x, x0, sizeof(double) * NX);
    memcpy(P, P0, sizeof(double) * NS * NS);
    Lags lags = lags_of(log);
    for (int j = 0; j < NY; j++) {
        double early, late;
        if (!lags.on[j]) continue;
        bend_weights(log->lags[j], &early, &late);
        bent[j] = 4.0 * (early + late); /* a parabola is the sum of both bends */
    }
    for (int k = 0; k < log->rows; k++) {
        double y[NY];
        if (run_follows) follow(log, k, p, z, x, memory);
        for (int j = 0; j < NY; j++) {
            const double age = log->late ? log->late[NY * k + j] : 0.0, value = run_outputs[NY * k + j];
            if (!isfinite(value)) return k;
            if (!lags.on[j]) {
                y[j] = run_at(log, k, j, age);
                continue;
            }
            if (k == 0) lags.m[j] = (1.0 - lags.alpha[j]) * value;
            lags.m[j] += bent[j] * run_bends[NY * k + j];
            const double now = lag_over_row(&lags, j, lags.m + j, value);
            y[j] = lagged_at(&lags, log, k, j, age, now, k > 0 ? before[j] : now, bent[j]);
            before[j] = now;
        }
        if (k > 0 && k <= log->settle) memcpy(P, P0, sizeof(double) * NS * NS);
#if UNNAMED
        if (k > 0) unnamed_terms(log, k - 1, p, z, known, unnamed);
#endif
        if (k > 0) go_on(z, 0, 1, hidden, fades, log->step);
#if UNNAMED
        for (int j = 0; k > 0 && j < NY; j++) z[ND + j] += log->step * unnamed[j];
#endif
        if (k > 0 && k > log->settle) {
            go_on(P, first, NS, hidden, fades, log->step);
            transposed(P);
            go_on(P, first, NS, hidden, fades, log->step);
            for (int j = NW; j < ND; j++) P[(NS + 1) * j] += q[j] * log->step;
        }
        for (int j = 0; j < NY; j++) {
            const double measured = log->y[NY * k + j];
            double slopes[NK + 1], PH[NS + 1];
            for (int i = 0; i < NK; i++) {
                slopes[i] = run_slopes[NK * (NY * k + j) + i];
                if (!lags.on[j]) continue;
                if (k == 0) kept[j][i] = (1.0 - lags.alpha[j]) * slopes[i];
                slopes[i] = lag_over_row(&lags, j, kept[j] + i, slopes[i]);
            }
            errors[NY * k + j] = variances[NY * k + j] = NAN;
            if (isnan(measured)) continue;
            double e = measured - y[j] - z[ND + j], s = r[NY * k + j];
            for (int l = first; l < NS; l++) {
                PH[l] = P[NS * l + ND + j];
                for (int i = 0; i < NK; i++) PH[l] += P[NS * l + NZ + i] * slopes[i];
            }
            s += PH[ND + j];
            for (int i = 0; i < NK; i++) {
                e -= slopes[i] * z[NZ + i];
                s += slopes[i] * PH[NZ + i];
            }
            errors[NY * k + j] = e;
            variances[NY * k + j] = s;
            for (int l = first; l < NS; l++) z[l] += PH[l] * e / s;
            for (int l = first; l < NS; l++)
                for (int i = first; i <= l; i++) P[NS * i + l] = P[NS * l + i] -= PH[l] * PH[i] / s;
        }
        if (states) {
            memcpy(states + NX * k, run_states + NX * k, sizeof(double) * NX);
            for (int i = 0; i < NS; i++) states[NX * k + NB + i] = z[i] + (i < NZ ? 0.0 : x0[NB + i]);
        }
        if (memories) memcpy(memories + NM * k, run_memories + NM * k, sizeof(double) * NM);
        if (covariances) memcpy(covariances + NS * NS * k, P, sizeof(double) * NS * NS);
    }
    return log->rows;
}
