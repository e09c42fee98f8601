/* An instance of a model: its variables and phases, guarded; its state, kept and put back. No word of FMI. */
#include "model.h"

static const char *const PHASES[] = {"instantiated", "initialization", "step", "event mode", "continuous-time mode", "terminated"};

static void say(Instance *m, int warning, const char *format, va_list arguments)
{
    va_list again;
    va_copy(again, arguments);
    int size = vsnprintf(NULL, 0, format, again);
    va_end(again);
    char *message = size < 0 ? NULL : malloc((size_t)size + 1);
    if (message != NULL) {
        vsnprintf(message, (size_t)size + 1, format, arguments);
        if (m->computing) restore_mode(m->host_mode);
        m->log(m, warning, message);
        if (m->computing) flush_subnormals();
    }
    free(message);
}

static int refuse(Instance *m, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    say(m, 0, format, arguments);
    va_end(arguments);
    return 1;
}

#if RANGES
static void warn(Instance *m, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    say(m, 1, format, arguments);
    va_end(arguments);
}
#endif

/* -- floating point ------------------------------------------------------------------------------------------------ */

/* Around all that the model computes; calls that only move values need none. */
static void begin_computing(Instance *m)
{
    m->host_mode = flush_subnormals();
    m->computing = 1;
}

/* The host's mode again; what the model returned is passed on. */
static int end_computing(Instance *m, int refused)
{
    m->computing = 0;
    restore_mode(m->host_mode);
    return refused;
}

/* -- history ------------------------------------------------------------------------------------------------------ */

#define ROW (1 + INPUTS)

static double *row_of(const History *h, size_t k)
{
    return h->rows + ROW * (h->first + k);
}

static int append(Instance *m, double t, const double *command)
{
    History *h = &m->history;
    if (h->first + h->count == h->room) {
        if (h->first > h->room / 2) {
            memmove(h->rows, row_of(h, 0), sizeof(double) * ROW * h->count);
            h->first = 0;
        } else {
            size_t room = h->room ? 2 * h->room : 64;
            double *rows = realloc(h->rows, sizeof(double) * ROW * room);
            if (rows == NULL) return refuse(m, "not enough memory for the history of commands");
            h->rows = rows;
            h->room = room;
        }
    }
    double *row = row_of(h, h->count++);
    row[0] = t;
    memcpy(row + 1, command, sizeof(double) * INPUTS);
    return 0;
}

static void forget(History *h)
{
    h->first = h->count = 0;
}

/* -- life --------------------------------------------------------------------------------------------------------- */

static void reset(Instance *m)
{
    m->phase = INSTANTIATED;
    m->start_time = m->time = 0.0;
    m->current = m->warned = m->is_stale = 0;
    memset(m->is_set, 0, sizeof m->is_set);
    memset(m->text, 0, sizeof m->text);
    memset(m->own, 0, sizeof m->own);
    memset(m->awake, 0, sizeof m->awake);
    forget(&m->history);
    for (int k = 0; k < VARIABLES; k++) m->values[k] = variables[k].start;
    for (int k = 0; k < TEXTS; k++) strncpy(m->text[k], texts[k], TEXT_SIZE - 1);
}

static Instance *created(int exchange, void *host, void (*log)(Instance *, int, const char *))
{
    Instance *m = calloc(1, sizeof *m);
    if (m == NULL) return NULL;
    m->exchange = exchange;
    m->host = host;
    m->log = log;
    reset(m);
    return m;
}

static void dispose(Instance *m)
{
    free(m->history.rows);
    free(m);
}

static int refresh(Instance *m)
{
    if (m->current) return 0;
    begin_computing(m);
    if (end_computing(m, initialize(m))) return 1;
    m->current = 1;
    return 0;
}

/* The phase in which something is asked for must be one of those that a bit stands for. */
static int in_phase(Instance *m, unsigned allowed, const char *asked)
{
    if (allowed >> m->phase & 1u) return 0;
    const char *cure = m->phase < STEP ? "; end initialization first" : "";
    return refuse(m, "%s while %s%s", asked, PHASES[m->phase], cure);
}

#define IN(phase) (1u << (phase))

static int start_at(Instance *m, double t)
{
    if (in_phase(m, IN(INSTANTIATED), "an experiment is set up")) return 1;
    if (!isfinite(t)) return refuse(m, "the start time is %g s; use a finite number", t);
    m->start_time = m->time = t;
    return 0;
}

static int enter_initialization(Instance *m)
{
    if (in_phase(m, IN(INSTANTIATED), "initialization is entered")) return 1;
    m->phase = INITIALIZATION;
    m->current = 0;
    return 0;
}

static int exit_initialization(Instance *m)
{
    if (in_phase(m, IN(INITIALIZATION), "initialization is left")) return 1;
    if (refresh(m)) return 1;
    m->phase = m->exchange ? EVENT : STEP;
    return 0;
}

static int step(Instance *m, double t, double h)
{
    if (in_phase(m, IN(STEP), "a step")) return 1;
    if (!(h > 0.0 && isfinite(h) && isfinite(t)))
        return refuse(m, "step of %.15g s at t = %.15g s; it must be positive and finite", h, t);
    begin_computing(m);
    return end_computing(m, advance(m, t, h));
}

static int set_time(Instance *m, double t)
{
    if (in_phase(m, IN(EVENT) | IN(CONTINUOUS), "time is set")) return 1;
    if (!isfinite(t)) return refuse(m, "time is set to %g s; use a finite number", t);
    m->time = t;
    m->is_stale = 1;
    return 0;
}

/* -- values ------------------------------------------------------------------------------------------------------- */

static const char *const KINDS[] = {"Real", "Boolean", "String"};

static int is_kind(Instance *m, size_t k, Kind kind)
{
    if (k >= VARIABLES) return refuse(m, "there is no %s with value reference %zu", KINDS[kind], k);
    if (variables[k].kind == kind) return 0;
    return refuse(m, "%s is %s, not %s", variables[k].name, KINDS[variables[k].kind], KINDS[kind]);
}

/* Before something is read: in initialization, what follows from what was set. */
static int settle(Instance *m)
{
    return m->phase == INITIALIZATION ? refresh(m) : 0;
}

/* Before outputs are read, which a solver or a new input may have left behind. A filter's belong to its sample. */
static int make_readable(Instance *m)
{
    if (settle(m)) return 1;
    if (!EXCHANGE || !m->is_stale || (m->phase != STEP && m->phase != EVENT && m->phase != CONTINUOUS)) return 0;
    begin_computing(m);
    return end_computing(m, refresh_outputs(m));
}

static int check_settable(Instance *m, size_t k, Kind kind)
{
    if (is_kind(m, k, kind)) return 1;
    if (variables[k].causality == OUTPUT) return refuse(m, "%s is an output", variables[k].name);
    if (variables[k].causality == PARAMETER && m->phase > INITIALIZATION)
        return refuse(m, "%s is a fixed parameter; set it before the end of initialization", variables[k].name);
    return 0;
}

static void mark(Instance *m, size_t k)
{
    m->is_stale = 1;
    if (m->phase > INITIALIZATION) return;
    m->is_set[k] = 1;
    m->current = 0;
}

static int set_number(Instance *m, size_t k, Kind kind, double value)
{
    if (check_settable(m, k, kind)) return 1;
    if (!isfinite(value)) return refuse(m, "%s is set to %g; use a finite number", variables[k].name, value);
    m->values[k] = value;
    mark(m, k);
    return 0;
}

static int set_text(Instance *m, size_t k, const char *value)
{
    if (check_settable(m, k, STRING)) return 1;
    if (value == NULL || strlen(value) >= TEXT_SIZE)
        return refuse(m, "%s is set to a text that is too long", variables[k].name);
    char *text = m->text[(size_t)variables[k].start];
    memset(text, 0, TEXT_SIZE);
    memcpy(text, value, strlen(value));
    mark(m, k);
    return 0;
}

/* Every parameter that was set lies within its bounds, or all that do not are said. */
static int check_bounds(Instance *m)
{
    char *faults = NULL;
    size_t used = 0;
    for (int k = 0; k < VARIABLES; k++) {
        const Variable *v = &variables[k];
        if (!m->is_set[k] || v->causality != PARAMETER || v->kind != REAL) continue;
        if (v->low <= m->values[k] && m->values[k] <= v->high) continue;
        const char *format = "%s%s is %.15g; allowed range: [%g, %g]%s%s";
        const char *join = used ? "; " : "", *space = v->unit[0] ? " " : "";
        int more = snprintf(NULL, 0, format, join, v->name, m->values[k], v->low, v->high, space, v->unit);
        char *longer = more < 0 ? NULL : realloc(faults, used + (size_t)more + 1);
        if (longer == NULL) break;
        faults = longer;
        used += (size_t)snprintf(faults + used, (size_t)more + 1, format, join, v->name, m->values[k], v->low, v->high, space, v->unit);
    }
    if (!used) return 0;
    refuse(m, "%s", faults);
    free(faults);
    return 1;
}

/* -- state -------------------------------------------------------------------------------------------------------- */

/* GUID (GUID_SIZE bytes), then doubles: six sizes, phase, times, flags, values, which were given, own, rows of history,
 * history; then the texts. Read in Python by cosim/fmi/state.py. */
#define FIXED (13 + 2 * VARIABLES + OWN)

typedef struct {
    size_t size;
    char bytes[];
} Snapshot;

static size_t state_size(size_t rows)
{
    return GUID_SIZE + sizeof(double) * (FIXED + ROW * rows) + TEXTS * TEXT_SIZE;
}

static Snapshot *snapshot(const Instance *m)
{
    const size_t rows = m->history.count, size = state_size(rows);
    Snapshot *s = calloc(1, sizeof *s + size);
    double *d = calloc(FIXED + ROW * rows, sizeof *d), *at = d;
    if (s != NULL && d != NULL) {
        s->size = size;
        const double sizes[] = {INPUTS, VARIABLES, STATES, MEMORIES, OWN, TEXTS * TEXT_SIZE};
        for (size_t k = 0; k < 6; k++) *at++ = sizes[k];
        const double flags[] = {m->phase, m->start_time, m->time, m->current, m->warned, m->is_stale};
        for (size_t k = 0; k < 6; k++) *at++ = flags[k];
        for (int k = 0; k < VARIABLES; k++) *at++ = m->values[k];
        for (int k = 0; k < VARIABLES; k++) *at++ = m->is_set[k];
        for (int k = 0; k < OWN; k++) *at++ = m->own[k];
        *at++ = (double)rows;
        if (rows) memcpy(at, row_of(&m->history, 0), sizeof(double) * ROW * rows);
        strncpy(s->bytes, MODEL_GUID, GUID_SIZE);
        memcpy(s->bytes + GUID_SIZE, d, sizeof *d * (FIXED + ROW * rows));
        memcpy(s->bytes + size - TEXTS * TEXT_SIZE, m->text, TEXTS * TEXT_SIZE);
    } else {
        free(s);
        s = NULL;
    }
    free(d);
    return s;
}

static int restore(Instance *m, const char *bytes, size_t size)
{
    char guid[GUID_SIZE + 1] = {0};
    double d[FIXED], *at = d + 6;
    if (size >= state_size(0)) memcpy(guid, bytes, GUID_SIZE);
    if (strcmp(guid, MODEL_GUID) != 0) return refuse(m, "this FMU state belongs to another FMU");
    memcpy(d, bytes + GUID_SIZE, sizeof d);
    const double rows = d[FIXED - 1];
    if (!(rows >= 0.0 && rows <= 1e12 && size == state_size((size_t)rows) && *at >= 0.0 && *at <= TERMINATED))
        return refuse(m, "this FMU state is damaged");
    forget(&m->history);
    const char *row = bytes + GUID_SIZE + sizeof d;
    for (size_t k = 0; k < (size_t)rows; k++, row += sizeof(double) * ROW) {
        double command[ROW];
        memcpy(command, row, sizeof command);
        if (append(m, command[0], command + 1)) return 1;
    }
    m->phase = (Phase)*at++;
    m->start_time = *at++;
    m->time = *at++;
    m->current = *at++ != 0.0;
    m->warned = *at++ != 0.0;
    m->is_stale = *at++ != 0.0;
    for (int k = 0; k < VARIABLES; k++) m->values[k] = *at++;
    for (int k = 0; k < VARIABLES; k++) m->is_set[k] = *at++ != 0.0;
    for (int k = 0; k < OWN; k++) m->own[k] = *at++;
    memcpy(m->text, bytes + size - TEXTS * TEXT_SIZE, TEXTS * TEXT_SIZE);
    after_restore(m);
    return 0;
}
