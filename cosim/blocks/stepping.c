/* Communication steps of a system, from k = `next` to k = `last`, without Python between them.

   At k every slot whose turn it is takes what its pulls bring, puts its inputs, steps to k, takes late values, which it puts
   too, and gets its outputs; then the held transfers are made and the row is kept. `run` returns wherever Python has a word to say, and goes on from that very
   place when it is called again. All memory is the caller's. Compiled without contraction: the same bytes as in Python. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

#ifdef __clang__ /* gcc contracts nothing under -std=c99 */
#pragma STDC FP_CONTRACT OFF
#endif

typedef void (*Function)(void);

enum { PUT, ADVANCE, GET };                                       /* what is called, as in isolation/rows.py */
enum { FINISHED, STATUS, NOT_FINITE, UNFIT, NO_ITEM, TERMINATED, PAUSED, LATER }; /* why `run` returned */
enum { DOUBLES, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, BOOL8 };
enum { PREPARED };                                                /* version of slots that are no FMU */
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

typedef struct {           /* a connection; every: points between two transfers */
    const double *from;
    double *to;
    int64_t every, links;
    const Link *link;
} Transfer;

typedef struct {           /* variables of one type, moved in one call; `values` is their place in the row where they are doubles */
    Function function;
    const unsigned *references;
    size_t count, scalars;
    void *values;
    double *row, low, high;
    size_t finite;         /* so many of the first values got must be finite */
    int32_t type;
} Move;

typedef struct {           /* a polynomial through the last values of inputs, the newest first; see master/extrapolation.py */
    int64_t degree, inputs, points; /* points: so many there are */
    double *const *place;  /* of the inputs in the row */
    double *times, *values; /* degree + 1 points */
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
    bool event, terminate, early;
    bool again;            /* the inputs of the step's end are put after it */
} Slot;

typedef struct {
    double begin, h;
    int64_t slots, holds, width, next, last;
    int64_t pause;         /* Python is asked before the row of this point is kept */
    Slot *slot;
    const Transfer *hold;
    const double *row;
    double *table;
    volatile int64_t *counter, *doing; /* for observers: number of complete rows, current call */
    const volatile int64_t *asked;     /* not 0: Python is wanted after this step */
    int64_t place, phase, move;     /* where to go on */
    int64_t called, moving;         /* what was called, with which of its moves, and its status: for Python to judge */
    int32_t status;
} Plan;

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

static bool make_transfers(const Transfer *transfers, int64_t count, int64_t k)
{
    for (int64_t n = 0; n < count; n++) {
        const Transfer *t = &transfers[n];
        bool ok = true;
        double v = *t->from;
        if (t->every != 1 && k % t->every) continue;
        for (int64_t m = 0; m < t->links; m++) v = apply_link(&t->link[m], k, v, &ok);
        *t->to = v;
        if (!ok) return false;
    }
    return true;
}

static void add_point(Course *c, double t)
{
    const size_t row = (size_t)c->inputs;
    memmove(c->times + 1, c->times, (size_t)c->degree * sizeof(double));
    memmove(c->values + row, c->values, (size_t)c->degree * row * sizeof(double));
    c->times[0] = t;
    for (size_t n = 0; n < row; n++) c->values[n] = *c->place[n];
    if (c->points <= c->degree) c->points++;
}

/* Into the row, the means from t over h */
static void put_means(const Course *c, double t, double h)
{
    const size_t row = (size_t)c->inputs;
    const double *time = c->times, ahead = (t - time[0]) + 0.5 * h;
    for (size_t n = 0; n < row && c->points > 1; n++) {
        const double *v = c->values + n, gap = time[0] - time[1], slope = (v[0] - v[row]) / gap;
        double mean = v[0] + ahead * slope;
        if (c->points > 2) {
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

static void decode(const Move *m)
{
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

static int judge(Plan *p, int64_t called, int status)
{
    p->called = called;
    p->status = status;
    return STATUS;
}

/* All inputs from where they were left, in `move` */
static int put_inputs(Plan *p, const Slot *s)
{
    while (p->move < s->puts) {
        const Move *m = &s->put[p->moving = p->move];
        int status;
        *p->doing = s->doing + PUT;
        if (!encode(m)) return UNFIT;
        p->move++;
        if ((status = move(s, m)) != 0) return judge(p, PUT, status);
    }
    return FINISHED;
}

/* One slot, from where it was left: what is judged has been called, and is not called again. */
enum { PULLS, PUTS, STEPS, STEPPED, LATE_PUTS, GETS, GOT };

static int step_slot(Plan *p, Slot *s, int64_t k)
{
    const double since = k == 1 ? p->begin : p->begin + (double)(k - s->every) * p->h;
    const double length = (p->begin + (double)k * p->h) - since;
    int status, why;
    switch (p->phase) {
    case PULLS:
        if (s->course && !s->course->points) add_point(s->course, since);
        if (!make_transfers(s->pull, s->pulls, k)) return NO_ITEM;
        if (s->version == PREPARED) {
            memcpy(s->row, s->prepared + (size_t)(k - s->since) * s->scalars, s->scalars * sizeof(double));
            s->time = since + length;
            return FINISHED;
        }
        if (s->past) {
            add_point(s->past, since);
            put_means(s->past, since, length);
        }
        if (s->course) {
            add_point(s->course, since + length);
            put_means(s->course, since, length);
        }
        p->move = 0;
        p->phase = PUTS; /* fall through */
    case PUTS:
        if ((why = put_inputs(p, s)) != FINISHED) return why;
        if (s->past) put_newest(s->past);
        if (s->course) put_newest(s->course); /* fall through */
    case STEPS:
        *p->doing = s->doing + ADVANCE;
        status = 0;
        if (!s->step) { /* outputs are read again, at the end of a step */
        } else if (s->version == 2) {
            status = ((Step2)s->step)(s->instance, since, length, 1);
        } else {
            status = ((Step3)s->step)(s->instance, since, length, true, &s->event, &s->terminate, &s->early, &s->reached);
            if (s->terminate && status < 2) {
                if (!s->early) s->reached = since + length;
                return TERMINATED;
            }
        }
        p->phase = STEPPED;
        if (status != 0) {
            s->time = since;
            return judge(p, ADVANCE, status);
        } /* fall through */
    case STEPPED:
        s->time = since + length;
        if (!make_transfers(s->late, s->lates, k)) return NO_ITEM;
        p->move = s->lates || s->again ? 0 : s->puts;
        p->phase = LATE_PUTS; /* fall through */
    case LATE_PUTS:
        if ((why = put_inputs(p, s)) != FINISHED) return why;
        p->move = 0;
        p->phase = GETS; /* fall through */
    case GETS:
        while (p->move < s->gets) {
            *p->doing = s->doing + GET;
            status = move(s, &s->get[p->moving = p->move]);
            p->phase = GOT;
            if (status != 0) return judge(p, GET, status); /* fall through */
    case GOT:
            decode(&s->get[p->move]);
            if (!all_finite(s->get[p->move].row, s->get[p->move].finite)) return NOT_FINITE;
            p->move++;
            p->phase = GETS;
        }
    }
    return FINISHED;
}

/* Until `last`, or until Python is asked: then `place`, `phase`, `move` tell where, and go on from there. */
int run(Plan *p)
{
    const time_t now = time(NULL);
    int why;
    for (; p->next <= p->last; p->next++) {
        const int64_t k = p->next;
        for (; p->place < p->slots; p->place++) {
            Slot *s = &p->slot[p->place];
            if (s->every != 1 && k % s->every) continue;
            if ((why = step_slot(p, s, k)) != FINISHED) return why;
            p->phase = PULLS;
        }
        if (p->place == p->slots) {
            if (!make_transfers(p->hold, p->holds, k)) return NO_ITEM;
            p->place++;
            if (k == p->pause) return PAUSED;
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
