/* Communication steps of a system, from k = `next` to k = `last`, without Python between them.

   At k every slot whose turn it is takes what its pulls bring, puts its inputs, steps to k, takes late values, which it puts
   too, and gets its outputs; then the held transfers are made and the row is kept. `run` returns wherever Python has a word to say, and goes on from that very
   place when it is called again. All memory is the caller's. Compiled without contraction: the same bytes as in Python. */
#define _POSIX_C_SOURCE 199506L
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#ifndef _WIN32
#include <pthread.h>
#include <signal.h>
#endif

#ifdef __clang__ /* gcc contracts nothing under -std=c99 */
#pragma STDC FP_CONTRACT OFF
#endif

typedef void (*Function)(void);

enum { PUT, ADVANCE, GET };                                       /* what is called, as in isolation/rows.py */
enum { FINISHED, STATUS, NOT_FINITE, UNFIT, NO_ITEM, TERMINATED, PAUSED, LATER, ASKED }; /* why `run` returned */
enum { DOUBLES, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, BOOL8, BITS64, TEXT };
enum { TIMED = 4, MOST_TOGETHER = 64 };                           /* first steps to time; slots that step together */
#define SLOW 50e-6                                                /* shortest step [s] that is worth a thread */
enum { IN_PYTHON = -1, PREPARED };                                                /* version of slots that are no FMU */
enum { AFFINE, ADDED, BIAS, SCALE, STUCK, SPIKES, DELAYED, HELD, ITEMS };

typedef struct {           /* what becomes of a value on its way, at points first..last or always */
    int32_t kind;
    int64_t first, last;
    double a, b;
    const double *values;  /* one a point; of ITEMS `count` of them */
    const uint8_t *marks;  /* one a point */
    double *past;          /* `count` previous values */
    int64_t count;
} Link;

typedef struct {           /* a value that no double holds: 64 bits, or a text of its own */
    int64_t is_text;
    uint64_t bits;
    char *text;
} Cell;

typedef struct {           /* a connection; every: points between two transfers */
    const double *from;
    double *to;
    int64_t every, links;
    const Link *link;
    const Cell *from_cell; /* a connection of such values, otherwise NULL */
    Cell *to_cell;
} Transfer;

typedef struct {           /* variables of one type, moved in one call; `values` is their place in the row where they are doubles */
    Function function;
    const unsigned *references;
    size_t count, scalars;
    void *values;
    double *row, low, high;
    Cell *cell;            /* of values that no double holds, otherwise NULL */
    size_t finite;         /* so many of the first values got must be finite */
    int32_t type;
} Move;

typedef struct {           /* a polynomial through the last values of inputs, the newest first; see master/extrapolation.py */
    int64_t degree, inputs, points, room; /* points: so many there are, of `room` */
    double *const *place;  /* of the inputs in the row */
    double *times, *values;
} Course;

/* An FMU; or (PREPARED) values that were prepared, `scalars` for each point from `since` on */
typedef struct {
    int32_t version;
    Function step;
    void *instance;
    int64_t every, doing, pulls, lates, puts, gets;
    const Transfer *pull, *late; /* before and after its step */
    const Move *put, *get;
    const double *prepared;
    double *row;
    size_t scalars;
    int64_t since;
    double time;           /* to which it has come */
    double reached;        /* FMI 3.0: what fmi3DoStep says */
    Course *past, *course; /* of extrapolated and of interpolated inputs, or NULL */
    int64_t phase, move;   /* where to go on */
    int64_t called, moving; /* what was called, with which of its moves, and its status: for Python to judge */
    int64_t batch;         /* so many slots from this one on may step at the same time */
    double begin, length;  /* of the present step */
    double least;          /* time of the fastest of the first `timed` steps [s] */
    int32_t status, why, timed; /* why: reason for a return, found ahead of its turn */
    bool event, terminate, early;
    bool again;            /* the inputs of the step's end are put after it */
    bool stepped;          /* in this step */
} Slot;

typedef struct {
    double begin, h;
    double since, length;  /* of all steps, if `length` is not 0 */
    int64_t slots, holds, width, next, last;
    int64_t pause;         /* Python is asked before the row of this point is kept */
    Slot *slot;
    const Transfer *hold;
    const double *row;
    double *table;
    volatile int64_t *counter, *doing; /* for observers: number of complete rows, current call */
    const volatile int64_t *asked;     /* not 0: Python is wanted after this step */
    int64_t place;                  /* slot where to go on */
    Cell *cells;
    int64_t cell_count;
    bool changed;                   /* whether a cell has another value than in the last row */
    int64_t threads;                /* that may step slots beside this one */
    void *pool;                     /* of these threads, made when they are needed */
} Plan;

static double seconds(void)
{
#ifdef _WIN32
    return 0.0; /* no slot is slow */
#else
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
#endif
}

typedef int (*Exchange2)(void *, const unsigned *, size_t, void *);
typedef int (*Exchange3)(void *, const unsigned *, size_t, void *, size_t);
typedef int (*Step2)(void *, double, double, int);
typedef int (*Step3)(void *, double, double, bool, bool *, bool *, bool *, double *);

/* `*ok` false where a value is no item of the enumeration it goes to */
static double apply_link(const Link *link, int64_t k, double v, bool *ok)
{
    const bool acts = link->first <= k && k <= link->last;
    switch (link->kind) {
    case AFFINE: return v * link->a + link->b;
    case ADDED: return v + link->values[k];
    case BIAS: return acts ? v + link->a : v;
    case SCALE: return acts ? v * link->a : v;
    case STUCK: return acts ? link->a : v;
    case SPIKES: return acts && link->marks[k] ? v + link->a : v;
    case DELAYED: /* past: a ring of the last `count` values, count - 1 points of delay */
        link->past[k % link->count] = v;
        if (!acts) return v;
        return link->past[k < link->count - 1 ? 0 : (k + 1) % link->count];
    case HELD:
        if (!(acts && link->marks[k])) link->past[0] = v;
        return link->past[0];
    case ITEMS:
        for (int64_t n = 0; n < link->count; n++)
            if (v == link->values[n]) return v;
        *ok = false;
    }
    return v;
}

/* Copies a text, or 64 bits; returns whether the value is another one. Without memory a text stays as it is. */
static bool assign(Cell *cell, const void *value)
{
    if (!cell->is_text) {
        const bool differs = memcmp(&cell->bits, value, sizeof cell->bits) != 0;
        memcpy(&cell->bits, value, sizeof cell->bits);
        return differs;
    }
    const char *text = value ? value : "";
    if (cell->text && !strcmp(cell->text, text)) return false;
    char *copy = malloc(strlen(text) + 1);
    if (!copy) return false;
    free(cell->text);
    cell->text = strcpy(copy, text);
    return true;
}

static bool make_transfers(Plan *p, const Transfer *transfers, int64_t count, int64_t k)
{
    for (int64_t n = 0; n < count; n++) {
        const Transfer *t = &transfers[n];
        bool ok = true;
        if (t->every != 1 && k % t->every) continue;
        if (t->to_cell) {
            const Cell *from = t->from_cell;
            p->changed |= assign(t->to_cell, from->is_text ? (const void *)from->text : &from->bits);
            continue;
        }
        double v = *t->from;
        for (int64_t m = 0; m < t->links; m++) v = apply_link(&t->link[m], k, v, &ok);
        *t->to = v;
        if (!ok) return false;
    }
    return true;
}

/* Drops points at or after the new one, because a step was taken back. */
static void add_point(Course *c, double t)
{
    const size_t row = (size_t)c->inputs, room = (size_t)c->room;
    while (c->points && c->times[0] >= t) {
        c->points--;
        memmove(c->times, c->times + 1, (room - 1) * sizeof(double));
        memmove(c->values, c->values + row, (room - 1) * row * sizeof(double));
    }
    memmove(c->times + 1, c->times, (room - 1) * sizeof(double));
    memmove(c->values + row, c->values, (room - 1) * row * sizeof(double));
    c->times[0] = t;
    for (size_t n = 0; n < row; n++) c->values[n] = *c->place[n];
    if (c->points < c->room) c->points++;
}

/* Into the row, the means from t over h */
static void put_means(const Course *c, double t, double h)
{
    const size_t row = (size_t)c->inputs;
    const double *time = c->times, ahead = (t - time[0]) + 0.5 * h;
    for (size_t n = 0; n < row && c->degree && c->points > 1; n++) {
        const double *v = c->values + n, gap = time[0] - time[1], slope = (v[0] - v[row]) / gap;
        double mean = v[0] + ahead * slope;
        if (c->degree > 1 && c->points > 2) {
            const double before = (v[row] - v[2 * row]) / (time[1] - time[2]);
            mean = mean + (ahead * (ahead + gap) + h * h / 12.0) * ((slope - before) / (time[0] - time[2]));
        }
        *c->place[n] = mean;
    }
}

static void put_newest(const Course *c)
{
    for (int64_t n = 0; n < c->inputs; n++) *c->place[n] = c->values[n];
}

#define ENCODED(TYPE) for (size_t n = 0; n < m->scalars; n++) ((TYPE *)m->values)[n] = (TYPE)m->row[n]; break
#define DECODED(TYPE) for (size_t n = 0; n < m->scalars; n++) m->row[n] = (double)((const TYPE *)m->values)[n]; break

/* From the row to the type in which an FMU takes them; false where one is not of it. */
static bool encode(const Move *m)
{
    if (m->type == DOUBLES) return true;
    if (m->cell) {
        for (size_t n = 0; n < m->scalars; n++)
            if (m->type == TEXT) ((const char **)m->values)[n] = m->cell[n].text;
            else ((uint64_t *)m->values)[n] = m->cell[n].bits;
        return true;
    }
    for (size_t n = 0; n < m->scalars; n++)
        if (m->type == FLOAT32) {
            if (fabs(m->row[n]) > m->high) return false;
        } else if (!(m->row[n] >= m->low && m->row[n] <= m->high && m->row[n] == floor(m->row[n]))) {
            return false;
        }
    switch (m->type) {
    case FLOAT32: ENCODED(float);
    case INT8: ENCODED(int8_t);
    case UINT8: case BOOL8: ENCODED(uint8_t);
    case INT16: ENCODED(int16_t);
    case UINT16: ENCODED(uint16_t);
    case INT32: ENCODED(int32_t);
    case UINT32: ENCODED(uint32_t);
    case INT64: ENCODED(int64_t);
    }
    return true;
}

static void decode(Plan *p, const Move *m)
{
    for (size_t n = 0; m->cell && n < m->scalars; n++)
        p->changed |= assign(&m->cell[n], m->type == TEXT ? ((const void **)m->values)[n] : &((uint64_t *)m->values)[n]);
    switch (m->type) {
    case FLOAT32: DECODED(float);
    case INT8: DECODED(int8_t);
    case UINT8: DECODED(uint8_t);
    case INT16: DECODED(int16_t);
    case UINT16: DECODED(uint16_t);
    case INT32: DECODED(int32_t);
    case UINT32: DECODED(uint32_t);
    case INT64: DECODED(int64_t);
    case BOOL8: for (size_t n = 0; n < m->scalars; n++) m->row[n] = ((const uint8_t *)m->values)[n] ? 1.0 : 0.0;
    }
}

static int move(const Slot *s, const Move *m)
{
    if (s->version == 2) return ((Exchange2)m->function)(s->instance, m->references, m->count, m->values);
    return ((Exchange3)m->function)(s->instance, m->references, m->count, m->values, m->scalars);
}

static bool all_finite(const double *v, size_t count)
{
    for (size_t n = 0; n < count; n++)
        if (!isfinite(v[n])) return false;
    return true;
}

static int judge(Slot *s, int64_t called, int status)
{
    s->called = called;
    s->status = status;
    return STATUS;
}

/* All inputs from where they were left, in `move` */
static int put_inputs(const Plan *p, Slot *s)
{
    while (s->move < s->puts) {
        const Move *m = &s->put[s->moving = s->move];
        int status;
        *p->doing = s->doing + PUT;
        if (!encode(m)) return UNFIT;
        s->move++;
        if ((status = move(s, m)) != 0) return judge(s, PUT, status);
    }
    return FINISHED;
}

static void make_step(Slot *s)
{
    const double begin = s->timed < TIMED ? seconds() : 0.0;
    if (!s->step) s->status = 0; /* outputs are read again, at the end of a step */
    else if (s->version == 2) s->status = ((Step2)s->step)(s->instance, s->begin, s->length, 1);
    else
        s->status = ((Step3)s->step)(s->instance, s->begin, s->length, true, &s->event, &s->terminate, &s->early, &s->reached);
    if (s->timed < TIMED) {
        const double spent = seconds() - begin;
        if (!s->timed++ || spent < s->least) s->least = spent;
    }
}

/* One slot, from where it was left: what is judged has been called, and is not called again. `ahead`: up to its step. */
enum { PULLS, PUTS, STEPS, STEPPED, LATE_PUTS, GETS, GOT };

static int go_on(Plan *p, Slot *s, int64_t k, bool ahead)
{
    int status, why;
    switch (s->phase) {
    case PULLS:
        if (p->length > 0.0) {
            s->begin = p->since;
            s->length = p->length;
        } else {
            s->begin = k == 1 ? p->begin : p->begin + (double)(k - s->every) * p->h;
            s->length = (p->begin + (double)k * p->h) - s->begin;
        }
        s->stepped = false;
        if (s->course && !s->course->points) add_point(s->course, s->begin);
        if (!make_transfers(p, s->pull, s->pulls, k)) return NO_ITEM;
        if (s->version == PREPARED) {
            memcpy(s->row, s->prepared + (size_t)(k - s->since) * s->scalars, s->scalars * sizeof(double));
            s->time = s->begin + s->length;
            return FINISHED;
        }
        if (s->past) {
            add_point(s->past, s->begin);
            put_means(s->past, s->begin, s->length);
        }
        if (s->course) {
            add_point(s->course, s->begin + s->length);
            put_means(s->course, s->begin, s->length);
        }
        s->move = 0;
        s->phase = PUTS; /* fall through */
    case PUTS:
        if ((why = put_inputs(p, s)) != FINISHED) return why;
        if (s->past) put_newest(s->past);
        if (s->course) put_newest(s->course);
        s->phase = STEPS; /* fall through */
    case STEPS:
        if (ahead) return FINISHED;
        if (!s->stepped) {
            *p->doing = s->doing + ADVANCE;
            make_step(s);
            s->stepped = true;
        }
        if (s->version == 3 && s->terminate && s->status < 2) {
            if (!s->early) s->reached = s->begin + s->length;
            return TERMINATED;
        }
        s->phase = STEPPED;
        if (s->status != 0) {
            s->time = s->begin;
            return judge(s, ADVANCE, s->status);
        } /* fall through */
    case STEPPED:
        s->time = s->begin + s->length;
        if (!make_transfers(p, s->late, s->lates, k)) return NO_ITEM;
        s->move = s->lates || s->again ? 0 : s->puts;
        s->phase = LATE_PUTS; /* fall through */
    case LATE_PUTS:
        if ((why = put_inputs(p, s)) != FINISHED) return why;
        s->move = 0;
        s->phase = GETS; /* fall through */
    case GETS:
        while (s->move < s->gets) {
            *p->doing = s->doing + GET;
            status = move(s, &s->get[s->moving = s->move]);
            s->phase = GOT;
            if (status != 0) return judge(s, GET, status); /* fall through */
    case GOT:
            decode(p, &s->get[s->move]);
            if (!all_finite(s->get[s->move].row, s->get[s->move].finite)) return NOT_FINITE;
            s->move++;
            s->phase = GETS;
        }
    }
    s->phase = PULLS;
    return FINISHED;
}

#ifndef _WIN32
/* Threads that make the steps of slots at the same time as the caller. */
typedef struct {
    pthread_mutex_t lock;
    pthread_cond_t begins, ends;
    Slot *slot[MOST_TOGETHER];
    int slots, taken, made, threads;
    bool over;
    pthread_t thread[MOST_TOGETHER];
} Pool;

/* Steps that nobody has taken; the lock is held before and after. */
static void take_steps(Pool *pool)
{
    while (pool->taken < pool->slots) {
        Slot *s = pool->slot[pool->taken++];
        pthread_mutex_unlock(&pool->lock);
        make_step(s);
        pthread_mutex_lock(&pool->lock);
        s->stepped = true;
        pool->made++;
        pthread_cond_signal(&pool->ends);
    }
}

static void *work(void *argument)
{
    Pool *pool = argument;
    pthread_mutex_lock(&pool->lock);
    while (!pool->over) {
        take_steps(pool);
        pthread_cond_wait(&pool->begins, &pool->lock);
    }
    pthread_mutex_unlock(&pool->lock);
    return NULL;
}

static Pool *make_pool(int64_t threads)
{
    Pool *pool = calloc(1, sizeof(Pool));
    const int faults[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGTRAP, SIGABRT};
    sigset_t all, before;
    if (!pool) return NULL;
    pthread_mutex_init(&pool->lock, NULL);
    pthread_cond_init(&pool->begins, NULL);
    pthread_cond_init(&pool->ends, NULL);
    sigfillset(&all); /* signals are for Python's thread, but those of a fault for the thread that has it */
    for (size_t n = 0; n < sizeof faults / sizeof *faults; n++) sigdelset(&all, faults[n]);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    while (pool->threads < threads && pool->threads < MOST_TOGETHER
           && pthread_create(&pool->thread[pool->threads], NULL, work, pool) == 0)
        pool->threads++;
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    return pool;
}

/* Steps of the slots from `first` on, of a batch: no one needs an output of another one of the same step. */
static void step_together(Plan *p, Slot *first, int64_t k)
{
    int64_t slow = 0;
    for (Slot *s = first; s < first + first->batch; s++) {
        if (s->version > PREPARED && s->timed < TIMED) return;
        slow += s->version > PREPARED && s->least >= SLOW;
    }
    if (slow < 2) return;
    if (!p->pool) p->pool = make_pool(p->threads);
    if (!p->pool) return;
    Pool *pool = p->pool;
    int count = 0;
    for (Slot *s = first; s < first + first->batch && count < MOST_TOGETHER; s++) {
        if (s->version <= PREPARED || s->least < SLOW || k % s->every) continue;
        s->why = go_on(p, s, k, true);
        if (s->why == FINISHED) pool->slot[count++] = s;
    }
    *p->doing = first->doing + ADVANCE;
    pthread_mutex_lock(&pool->lock);
    pool->taken = pool->made = 0;
    pool->slots = count;
    pthread_cond_broadcast(&pool->begins);
    take_steps(pool);
    while (pool->made < pool->slots) { /* what takes long is blamed */
        int n = 0;
        while (pool->slot[n]->stepped) n++;
        *p->doing = pool->slot[n]->doing + ADVANCE;
        pthread_cond_wait(&pool->ends, &pool->lock);
    }
    pthread_mutex_unlock(&pool->lock);
}
#endif

/* Another value of a cell, from the caller. */
void put_cell(Cell *cell, const void *value)
{
    assign(cell, value);
}

void finish(Plan *p)
{
    for (int64_t n = 0; n < p->cell_count; n++) {
        free(p->cells[n].text);
        p->cells[n].text = NULL;
    }
#ifndef _WIN32
    Pool *pool = p->pool;
    if (!pool) return;
    pthread_mutex_lock(&pool->lock);
    pool->over = true;
    pthread_cond_broadcast(&pool->begins);
    pthread_mutex_unlock(&pool->lock);
    for (int n = 0; n < pool->threads; n++) pthread_join(pool->thread[n], NULL);
    free(pool);
    p->pool = NULL;
#endif
}

/* All slots and the held transfers of point k, from `place` on. */
static int make_round(Plan *p, int64_t k)
{
    int why;
    for (; p->place < p->slots; p->place++) {
        Slot *s = &p->slot[p->place];
#ifndef _WIN32
        if (s->batch > 1 && s->phase == PULLS && p->threads) step_together(p, s, k);
#endif
        if (s->every != 1 && k % s->every) continue;
        if (s->version == IN_PYTHON) return ASKED;
        why = s->why;
        s->why = FINISHED;
        if (why != FINISHED || (why = go_on(p, s, k, false)) != FINISHED) return why;
    }
    if (!make_transfers(p, p->hold, p->holds, k)) return NO_ITEM;
    return FINISHED;
}

/* One step of all slots at point `next`, from `since` over `length`, or on from where Python was asked. */
int step_once(Plan *p)
{
    const int why = make_round(p, p->next);
    if (why == FINISHED) p->place = 0;
    return why;
}

/* Until `last`, or until Python is asked: then `place` and the slot's `phase` and `move` tell where, and go on from there. */
int run(Plan *p)
{
    const time_t now = time(NULL);
    int why;
    for (; p->next <= p->last; p->next++) {
        const int64_t k = p->next;
        if (p->place <= p->slots) {
            if ((why = make_round(p, k)) != FINISHED) return why;
            p->place = p->slots + 1;
            if (k == p->pause || p->changed) return PAUSED;
        }
        memcpy(p->table + k * p->width, p->row, (size_t)p->width * sizeof(double));
        *p->counter = k + 1;
        p->place = 0;
        if (*p->asked || time(NULL) != now) { /* so that Python sees signals, once a second */
            p->next++;
            return LATER;
        }
    }
    return FINISHED;
}
