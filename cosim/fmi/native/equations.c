/* A model of equations: what acts of a command, substeps, and the same equations for a solver of the host's.
 *
 * Printed above this text, each taking every effect's branch only while it is awake:
 *   derivatives(t, x, u, p, near, awake, out), outputs(t, x, u, p, awake, out)   the body; near: what is known nearby
 *   shape(t, h, u, memory, p, awake, out)                             what acts of a command, then the memory after it
 *   remember(t, memory, p, awake, out)                                memory at the start from its start values
 *   indicators, shape_indicators                                      what passes through zero at a kink
 *   derivative_slopes, output_slopes, shape_slopes(…, dx, du, …)      the derivative in a direction
 *   starts(p, x, memory, u, late), wake(p, awake)                     start values; which effects act
 * p are the values of the variables by value reference. */
#include "model.h"

#define STATE (m->own)
#define MEMORY (m->own + STATES)
#define ACTING (m->own + STATES + MEMORIES)
#define SEEN (m->own + STATES + MEMORIES + INPUTS)

static int has_delay(const Instance *m)
{
    return DELAY >= 0 && m->awake[DELAY >= 0 ? DELAY : 0];
}

/* Whether the command that acts changes at instants alone: a delay or an effect that remembers. */
static int is_discrete(const Instance *m)
{
    return has_delay(m) || remembers(m->awake);
}

static double delay_time(const Instance *m)
{
    return DELAY >= 0 ? m->values[DELAY_TIME] : 0.0;
}

/* -- start --------------------------------------------------------------------------------------------------------- */

static int write_outputs(Instance *m, double t)
{
    double y[OUTPUTS + 1];
    outputs(t, STATE, m->values, m->values, m->awake, y);
    for (int k = 0; k < OUTPUTS; k++)
        if (!isfinite(y[k])) return refuse(m, "%s is %g", variables[INPUTS + k].name, y[k]);
    memcpy(m->values + INPUTS, y, sizeof(double) * OUTPUTS);
    m->is_stale = 0;
    return 0;
}

static int initialize(Instance *m)
{
    double u[INPUTS + 1], late[INPUTS + 1];
    if (check_bounds(m)) return 1;
    wake(m->values, m->awake);
    if (m->exchange && counting(m->awake) != NULL)
        return refuse(m, "%s depends on substeps, which model exchange lacks: use co-simulation, or keep the effect off", counting(m->awake));
    m->warned = 0;
    m->time = m->start_time;
    starts(m->values, STATE, MEMORY, u, late);
    for (int k = 0; k < INPUTS; k++) if (!m->is_set[k]) m->values[k] = u[k];
    for (int k = 0; k < STATES; k++) if (m->is_set[STATE_START[k]]) STATE[k] = m->values[STATE_START[k]];
    for (int k = 0; k < MEMORIES; k++) if (m->is_set[MEMORY_START[k]]) MEMORY[k] = m->values[MEMORY_START[k]];
    double remembered[MEMORIES + 1];
    remember(m->time, MEMORY, m->values, m->awake, remembered);
    memcpy(MEMORY, remembered, sizeof(double) * MEMORIES);
    for (int k = 0; k < INPUTS && DELAY >= 0; k++) if (m->is_set[DELAY_START[k]]) late[k] = m->values[DELAY_START[k]];
    forget(&m->history);
    if (has_delay(m) && append(m, m->start_time - DELAY_LONGEST, late)) return 1;
    double shaped[INPUTS + MEMORIES + 1];
    shape(m->time, 0.0, has_delay(m) ? late : m->values, MEMORY, m->values, m->awake, shaped);
    memcpy(ACTING, shaped, sizeof(double) * INPUTS);
    memcpy(SEEN, m->values, sizeof(double) * INPUTS);
    return write_outputs(m, m->time);
}

static void after_restore(Instance *m)
{
    wake(m->values, m->awake);
}

static void check_range(Instance *m, double t)
{
#if RANGES
    for (int k = 0; k < RANGES && !m->warned; k++) {
        const Range *r = &RANGE[k];
        char values[256] = "";
        int inside = 1;
        size_t used = 0;
        for (int i = r->first; i < r->first + r->count; i++)
            inside = inside && r->low <= m->values[RANGE_INPUT[i]] && m->values[RANGE_INPUT[i]] <= r->high;
        if (inside) continue; /* at nearly every step, so that nothing is printed for it */
        for (int i = r->first; i < r->first + r->count && used < sizeof values; i++) {
            const char *join = i > r->first ? ", " : "", *unit = variables[RANGE_INPUT[i]].unit;
            used += (size_t)snprintf(values + used, sizeof values - used, "%s%g %s", join, m->values[RANGE_INPUT[i]], unit);
        }
        m->warned = 1;
        warn(m, "at t = %g s: %s %s: %s", t, r->quantity, values, r->beyond);
    }
#else
    (void)m, (void)t;
#endif
}

/* -- stepping ------------------------------------------------------------------------------------------------------ */

/* Mean of the delayed command over a substep, so that its impulse is exact for any delay; the oldest has always been there. */
static void mean_command(Instance *m, double t, double h, double *out)
{
    History *past = &m->history;
    const double begin = t - delay_time(m), end = t + h - delay_time(m);
    size_t first = past->count - 1;
    while (first > 0 && row_of(past, first)[0] > begin) first--;
    for (int j = 0; j < INPUTS; j++) out[j] = 0.0;
    for (size_t k = first; k < past->count; k++) {
        const double *row = row_of(past, k);
        double since = k ? row[0] : begin, until = k + 1 < past->count ? row_of(past, k + 1)[0] : t + h;
        if (since < begin) since = begin;
        if (until > end) until = end;
        const double overlap = (until > since ? until - since : 0.0) / h;
        for (int j = 0; j < INPUTS; j++) out[j] += overlap * row[1 + j];
    }
    while (past->count > 1 && row_of(past, 1)[0] <= t + h - DELAY_LONGEST) past->first++, past->count--;
}

#if STIFF
#define MOST STATES
#include "stiff.h"

typedef struct {
    const double *u;
    Instance *m;
} Acting;

static void rates_of(const void *of, double t, double share, const double *x, double *k)
{
    const Acting *acting = of;
    Near near[NEAR + 1];
    (void)share;
    forget_all(near, NEAR);
    derivatives(t, x, acting->u, acting->m->values, near, acting->m->awake, k);
}

static void substep(Instance *m, double t, double h, double *x, const double *u)
{
    const Acting acting = {u, m};
    const double still[INPUTS + 1] = {0.0};
    double J[STATES * STATES + 1], column[STATES + 1];
    Factored factored;
    for (int j = 0; j < STATES; j++) {
        double unit[STATES + 1] = {0.0};
        unit[j] = 1.0;
        derivative_slopes(t, x, u, m->values, unit, still, m->awake, column);
        for (int i = 0; i < STATES; i++) J[STATES * i + j] = column[i];
    }
    if (factor(STATES, h, J, &factored)) x[0] = NAN;
    else stiff_step(STATES, &factored, t, h, x, rates_of, &acting);
}
#else
#define KIND static
#define SHAPE [STATES + 1]
#define EACH for (int i = 0; i < STATES; i++)
#define AT [i]
#define ARGUMENTS double *x, const double *u, const double *p, Near *near, const unsigned char *awake
#define RATES(t, moment, x, k) derivatives(t, x, u, p, near, awake, k)
#include "rk4.h"

static void substep(Instance *m, double t, double h, double *x, const double *u)
{
    Near near[NEAR + 1];
    forget_all(near, NEAR);
    rk4(t, h, x, u, m->values, near, m->awake);
}
#endif

static int not_finite(Instance *m, const double *before)
{
    const char *name = "";
    double largest = -1.0, value = 0.0;
    for (int k = 0; k < INPUTS + STATES; k++) {
        const double v = k < INPUTS ? m->values[k] : before[k - INPUTS];
        if (!(fabs(v) > largest)) continue;
        largest = fabs(v), value = v;
        name = k < INPUTS ? variables[k].name : STATE_NAME[k - INPUTS];
    }
    return refuse(m, "the state is not finite after the step; the largest state before it: %s = %g", name, value);
}

static int advance(Instance *m, double t, double h)
{
    double shaped[INPUTS + MEMORIES + 1], before[STATES + 1];
    const double counted = ceil(h / SUBSTEP - 1e-6);
    if (!(counted < 1e9)) return refuse(m, "step of %g s needs %g substeps", h, counted);
    const long n = counted < 1.0 ? 1 : (long)counted;
    const double dt = h / (double)n;
    check_range(m, t);
    memcpy(before, STATE, sizeof(double) * STATES);
    if (has_delay(m) && append(m, t, m->values)) return 1;
    memcpy(ACTING, m->values, sizeof(double) * INPUTS);
    for (long k = 0; k < n; k++) {
        const double now = t + (double)k * dt;
        if (SHAPING) {
            if (has_delay(m)) mean_command(m, now, dt, ACTING);
            else memcpy(ACTING, m->values, sizeof(double) * INPUTS);
            shape(now, dt, ACTING, MEMORY, m->values, m->awake, shaped);
            memcpy(ACTING, shaped, sizeof(double) * INPUTS);
            memcpy(MEMORY, shaped + INPUTS, sizeof(double) * MEMORIES);
        }
        substep(m, now, dt, STATE, ACTING);
    }
    m->time = t + h;
    for (int i = 0; i < STATES; i++) if (!isfinite(STATE[i])) return not_finite(m, before);
    return write_outputs(m, m->time);
}

/* -- model exchange ------------------------------------------------------------------------------------------------ */

static int refresh_outputs(Instance *m)
{
    return write_outputs(m, m->time);
}

/* An input that has moved between events, seen once a solver keeps a step (it tries times beyond the next event, too):
 * what remembers would have to know its whole course. */
static int check_held_inputs(Instance *m)
{
    if (!m->exchange || m->phase != CONTINUOUS || !is_discrete(m)) return 0;
    for (int k = 0; k < INPUTS; k++)
        if (fabs(m->values[k] - SEEN[k]) > 1e-9 * (1.0 + fabs(SEEN[k]))) /* a host that interpolates rounds */
            return refuse(m, "%s changes between events, at t = %.15g s: a delay or play needs piecewise constant inputs; "
                             "change it in event mode, or keep the effect off", variables[k].name, m->time);
    return 0;
}

/* The command that acts now. */
static void act(const Instance *m, double *u)
{
    double shaped[INPUTS + MEMORIES + 1];
    if (is_discrete(m) || !m->exchange) memcpy(u, ACTING, sizeof(double) * INPUTS);
    else {
        shape(m->time, 0.0, m->values, MEMORY, m->values, m->awake, shaped);
        memcpy(u, shaped, sizeof(double) * INPUTS);
    }
}

/* Whether the k-th command is due, to within rounding: a host's time may lack the last bits, and no solver steps that far. */
static int is_due(const Instance *m, size_t k)
{
    return row_of(&m->history, k)[0] + delay_time(m) <= m->time + 1e-12 * (1.0 + fabs(m->time));
}

/* Discrete states at an instant: the command that has arrived, and what remembers it. next: when the next arrives. */
static int update(Instance *m, double *next)
{
    double late[INPUTS + 1], shaped[INPUTS + MEMORIES + 1];
    *next = HUGE_VAL;
    check_range(m, m->time);
    m->is_stale = 1;
    if (!is_discrete(m)) return 0;
    memcpy(late, m->values, sizeof(double) * INPUTS);
    if (has_delay(m)) {
        History *past = &m->history;
        if (memcmp(row_of(past, past->count - 1) + 1, m->values, sizeof(double) * INPUTS) != 0 && append(m, m->time, m->values)) return 1;
        size_t k = past->count - 1;
        for (; k > 0 && !is_due(m, k); k--) *next = row_of(past, k)[0] + delay_time(m);
        memcpy(late, row_of(past, k) + 1, sizeof(double) * INPUTS);
    }
    begin_computing(m);
    shape(m->time, 0.0, late, MEMORY, m->values, m->awake, shaped);
    end_computing(m, 0);
    memcpy(ACTING, shaped, sizeof(double) * INPUTS);
    memcpy(MEMORY, shaped + INPUTS, sizeof(double) * MEMORIES);
    memcpy(SEEN, m->values, sizeof(double) * INPUTS);
    return 0;
}

/* A step the solver keeps: commands that have arrived are not asked for again. */
static int complete_step(Instance *m)
{
    if (check_held_inputs(m)) return 1;
    check_range(m, m->time);
    History *past = &m->history;
    while (past->count > 1 && is_due(m, 1)) past->first++, past->count--;
    return 0;
}

static int rates(Instance *m, double *dx)
{
    double u[INPUTS + 1];
    Near near[NEAR + 1];
    forget_all(near, NEAR);
    begin_computing(m);
    act(m, u);
    derivatives(m->time, STATE, u, m->values, near, m->awake, dx);
    end_computing(m, 0);
    for (int i = 0; i < STATES; i++)
        if (!isfinite(dx[i])) {
            refuse(m, "der(%s) is %g at t = %.15g s", STATE_NAME[i], dx[i], m->time);
            return UNDEFINED;
        }
    return 0;
}

static void crossings(Instance *m, double *z)
{
    double u[INPUTS + 1];
    begin_computing(m);
    act(m, u);
    indicators(m->time, STATE, u, m->values, m->awake, z);
    shape_indicators(m->time, 0.0, m->values, MEMORY, m->values, m->awake, z + BODY_KINKS);
    end_computing(m, 0);
    if (is_discrete(m)) for (int k = BODY_KINKS; k < KINKS; k++) z[k] = 1.0;
}

/* d(derivatives), d(outputs) for a change of the states and inputs. */
static void slopes(Instance *m, const double *sx, const double *su, double *dx, double *dy)
{
    double u[INPUTS + 1], moved[INPUTS + MEMORIES + 1] = {0};
    begin_computing(m);
    act(m, u);
    if (!is_discrete(m)) shape_slopes(m->time, 0.0, m->values, MEMORY, m->values, sx, su, m->awake, moved);
    derivative_slopes(m->time, STATE, u, m->values, sx, moved, m->awake, dx);
    output_slopes(m->time, STATE, m->values, m->values, sx, su, m->awake, dy);
    end_computing(m, 0);
}

/* -- what stands behind the variables: states, their derivatives, what effects remember ------------------------------ */

static int get_local(Instance *m, size_t k, double *value)
{
    const long states = VARIABLES, slopes_of = states + STATES, memory = slopes_of + STATES, kinks = memory + MEMORIES;
    const long i = (long)k, time = kinks + KINKS; /* the last two are variables in FMI 3.0 */
    if (i < states || i > time) return is_kind(m, k, REAL);
    if (i < slopes_of) *value = STATE[i - states];
    else if (i < memory) {
        double dx[STATES + 1];
        if (rates(m, dx)) return 1;
        *value = dx[i - slopes_of];
    } else if (i < kinks) *value = MEMORY[i - memory];
    else if (i < time) {
        double z[KINKS + 1];
        crossings(m, z);
        *value = z[i - kinks];
    } else *value = m->time;
    return 0;
}

static int check_count(Instance *m, size_t count, size_t expected, const char *noun)
{
    return count != expected && refuse(m, "there are %zu %s, not %zu", expected, noun, count);
}

static int get_states(Instance *m, double *x, size_t count)
{
    if (check_count(m, count, STATES, "states")) return 1;
    memcpy(x, STATE, sizeof(double) * STATES);
    return 0;
}

static int set_states(Instance *m, const double *x, size_t count)
{
    if (check_count(m, count, STATES, "states")) return 1;
    for (int k = 0; k < STATES; k++)
        if (!isfinite(x[k])) return refuse(m, "%s is set to %g; use a finite number", STATE_NAME[k], x[k]);
    memcpy(STATE, x, sizeof(double) * STATES);
    m->is_stale = 1;
    return 0;
}

static int get_rates(Instance *m, double *dx, size_t count)
{
    return check_count(m, count, STATES, "derivatives") ? 1 : rates(m, dx);
}

static int get_crossings(Instance *m, double *z, size_t count)
{
    if (check_count(m, count, KINKS, "event indicators")) return 1;
    crossings(m, z);
    return 0;
}

/* -- directional derivatives ---------------------------------------------------------------------------------------- */

typedef struct {
    double x[STATES + 1], u[INPUTS + 1], dx[STATES + 1], dy[OUTPUTS + 1];
} Direction;

static int directional_begin(Instance *m)
{
    const unsigned phases = IN(INITIALIZATION) | IN(STEP) | IN(EVENT) | IN(CONTINUOUS);
    return in_phase(m, phases, "directional derivatives are requested") || make_readable(m);
}

static int direction_add(Instance *m, Direction *d, size_t k, double change)
{
    const long i = (long)k - VARIABLES;
    if ((long)k < INPUTS) d->u[k] += change;
    else if (i >= 0 && i < STATES) d->x[i] += change;
    else return refuse(m, "directional derivatives need an input or a state; value reference %zu is neither", k);
    return 0;
}

static void direction_follow(Instance *m, Direction *d)
{
    slopes(m, d->x, d->u, d->dx, d->dy);
}

static int direction_read(Instance *m, const Direction *d, size_t k, double *slope)
{
    const long i = (long)k - VARIABLES - STATES, output = (long)k - INPUTS;
    if (output >= 0 && output < OUTPUTS) *slope = d->dy[output];
    else if (i >= 0 && i < STATES) *slope = d->dx[i];
    else return refuse(m, "directional derivatives exist for outputs and derivatives; value reference %zu is neither", k);
    return 0;
}
