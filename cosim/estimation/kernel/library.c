/* Derivatives, outputs and their slopes from the library of an FMU for model exchange, in continuous-time mode.
 *
 * Values are kept for a point (t, x, u), since each derivative asks for its own. Slopes are forward differences. */
static __thread double point[1 + NB + NU], value[NB + NL + 1], slope[(NB + NL + 1) * (NB + 1)];
static __thread double direction[(NB + 1) * (NB + 1)];
static __thread int is_placed, has_rates, has_outputs, has_slopes[2][NB + 1], has_direction[NB + 1];

/* Called before each run, with the instance of this thread. */
void use_library(const Library *used)
{
    library = used;
    point[0] = NAN; /* equals no time */
}

static int move_library(double t, const double *x, const double *u, const double *p)
{
    int status = ((SetTime)library->set_time)(library->instance, t);
    if (NB && status <= MOST_STATUS) status = ((SetStates)library->set_states)(library->instance, x, NB);
    return status <= MOST_STATUS ? put_inputs(t, x, u, p) : status;
}

/* Rates or outputs of the present point of the library. */
static int read_library(int of_outputs, double *out)
{
    return of_outputs ? get_outputs(out) : ((GetRates)library->get_rates)(library->instance, out, NB);
}

static int is_at(double t, const double *x, const double *u)
{
    return point[0] == t && !memcmp(point + 1, x, sizeof(double) * NB) && !memcmp(point + 1 + NB, u, sizeof(double) * NU);
}

static void evaluate_library(int of_outputs, double t, const double *x, const double *u, const double *p)
{
    int status = 0;
    if (!is_at(t, x, u)) {
        point[0] = t;
        memcpy(point + 1, x, sizeof(double) * NB);
        memcpy(point + 1 + NB, u, sizeof(double) * NU);
        is_placed = has_rates = has_outputs = 0;
        memset(has_slopes, 0, sizeof has_slopes);
        memset(has_direction, 0, sizeof has_direction);
    }
    if (of_outputs ? has_outputs : has_rates) return;
    if (!is_placed) status = move_library(t, x, u, p);
    is_placed = 1;
    if (status <= MOST_STATUS) status = read_library(of_outputs, value + of_outputs * NB);
    if (status > MOST_STATUS)
        for (int i = of_outputs * NB; i < (of_outputs ? NB + NL : NB); i++) value[i] = NAN;
    if (of_outputs) has_outputs = 1;
    else has_rates = 1;
}

/* After a substep, at its end. */
static void complete_library(double t, double *x, const double *u, const double *p)
{
    int event = 0, ends = 0, status = 0;
    bool event3 = false, ends3 = false;
    const Library *const first = library, *const both[] = {first->second, first};
    if (library->complete == NULL) return;
    for (int i = first->second == NULL; i < 2 && status <= MOST_STATUS; i++) {
        library = both[i];
        status = move_library(t, x, u, p);
        if (status <= MOST_STATUS)
            status = library->version == 2 ? ((Complete2)library->complete)(library->instance, 1, &event, &ends)
                                           : ((Complete3)library->complete)(library->instance, true, &event3, &ends3);
    }
    library = first;
    is_placed = 0;
    point[0] = NAN; /* the library may have changed */
    if (status > MOST_STATUS) x[0] = NAN;
}

static double library_value(int row, double t, const double *x, const double *u, const double *p)
{
    evaluate_library(row >= NB, t, x, u, p);
    return value[row];
}

static double library_slope(int row, int by, double t, const double *x, const double *u, const double *p)
{
    const int of_outputs = row >= NB;
    evaluate_library(of_outputs, t, x, u, p);
    if (!has_slopes[of_outputs][by]) {
        double moved[NB + 1], other[NB + NL + 1];
        const double h = library->steps[by];
        memcpy(moved, x, sizeof(double) * NB);
        moved[by] += h;
        is_placed = 0;
        int status = move_library(t, moved, u, p);
        if (status <= MOST_STATUS) status = read_library(of_outputs, other + of_outputs * NB);
        for (int i = of_outputs * NB; i < (of_outputs ? NB + NL : NB); i++)
            slope[i * (NB + 1) + by] = status > MOST_STATUS ? NAN : (other[i] - value[i]) / (moved[by] - x[by]);
        has_slopes[of_outputs][by] = 1;
    }
    return slope[row * (NB + 1) + by];
}

/* Rate per force along direction k, from both instances with the velocity moved to a usual speed and those of the other
 * directions to 0, so that it is also known at rest. */
static double library_direction(int k, int row, double t, const double *x, const double *u, const double *p)
{
    const Library *const first = library, *const both[] = {first->second, first};
    if (library->second == NULL) return 0.0; /* no term acts along it */
    evaluate_library(0, t, x, u, p);         /* so that values are those of this point */
    if (!has_direction[k]) {
        double moved[NB + 1], rates[2][NB + 1];
        int status = 0;
        memcpy(moved, x, sizeof(double) * NB);
        for (int j = 0; j < first->directions; j++) moved[first->braked[j]] = j == k ? first->speeds[k] : 0.0;
        for (int i = 0; i < 2 && status <= MOST_STATUS; i++) {
            library = both[i];
            status = move_library(t, moved, u, p);
            if (status <= MOST_STATUS) status = read_library(0, rates[i]);
        }
        library = first;
        is_placed = 0;
        const double force = -first->changes[k] * first->speeds[k];
        for (int i = 0; i < NB; i++)
            direction[k * (NB + 1) + i] = status > MOST_STATUS ? NAN : (rates[0][i] - rates[1][i]) / force;
        has_direction[k] = 1;
    }
    return direction[k * (NB + 1) + row];
}
