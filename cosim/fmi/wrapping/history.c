/* Inputs of the past, for a delay: rows of a time and NU values, straight between rows; a jump is two rows of one time. Before
 * the first row and after the last one, inputs stay as they are there. */
#define ROW (1 + NU)
#define EARLIER(t) ((t) + 1e-12 * (1.0 + fabs(t))) /* a host's time may lack the last bits */

typedef struct {
    double *rows;
    size_t first, count, room;
} History;

static double *row_of(const History *h, size_t k)
{
    return h->rows + ROW * (h->first + k);
}

static const double *last_of(const History *h)
{
    return row_of(h, h->count - 1);
}

/* 1 without memory for it. */
static int append(History *h, double t, const double *u)
{
    if (h->first + h->count == h->room) {
        if (h->first > h->room / 2) {
            memmove(h->rows, row_of(h, 0), sizeof(double) * ROW * h->count);
            h->first = 0;
        } else {
            const size_t room = h->room ? 2 * h->room : 64;
            double *rows = realloc(h->rows, sizeof(double) * ROW * room);
            if (rows == NULL) return 1;
            h->rows = rows;
            h->room = room;
        }
    }
    double *row = row_of(h, h->count++);
    row[0] = t;
    memcpy(row + 1, u, sizeof(double) * NU);
    return 0;
}

/* From a time on inputs are these. */
static int jump(History *h, double t, const double *u)
{
    double before[NU + 1];
    if (h->count == 0) return append(h, t, u);
    if (memcmp(last_of(h) + 1, u, sizeof(double) * NU) == 0) return 0;
    memcpy(before, last_of(h) + 1, sizeof(double) * NU);
    return (last_of(h)[0] < t && append(h, t, before)) || append(h, t, u);
}

/* Forget what is over at a time. */
static void forget(History *h, double t)
{
    while (h->count > 2 && row_of(h, 2)[0] < t) h->first++, h->count--;
}

static void forget_all(History *h)
{
    h->first = h->count = 0;
}

/* Add the integral of a straight line between two rows over [begin, end]. */
static void add_line(const double *from, const double *to, double begin, double end, double *sum)
{
    const double a = begin > from[0] ? begin : from[0], b = end < to[0] ? end : to[0], span = to[0] - from[0];
    if (!(b > a)) return;
    const double middle = (0.5 * (a + b) - from[0]) / span;
    for (int j = 1; j < ROW; j++) sum[j - 1] += (b - a) * (from[j] + middle * (to[j] - from[j]));
}

static void add_constant(const double *row, double span, double *sum)
{
    if (span > 0.0) for (int j = 1; j < ROW; j++) sum[j - 1] += span * row[j];
}

/* Mean over [begin, end]. */
static void mean_of(const History *h, double begin, double end, double *out)
{
    const double *first = row_of(h, 0), *last = last_of(h), span = end - begin;
    for (int j = 0; j < NU; j++) out[j] = 0.0;
    add_constant(first, (end < first[0] ? end : first[0]) - begin, out);
    for (size_t k = 0; k + 1 < h->count; k++) add_line(row_of(h, k), row_of(h, k + 1), begin, end, out);
    add_constant(last, end - (begin > last[0] ? begin : last[0]), out);
    for (int j = 0; j < NU; j++) out[j] /= span;
}

/* Value at a time, before the jump at `hidden` and those after it. */
static void value_at(const History *h, double t, double hidden, double *out)
{
    size_t k = 0;
    while (k + 1 < h->count && row_of(h, k + 1)[0] <= t) {
        if (row_of(h, k + 1)[0] == row_of(h, k)[0] && row_of(h, k)[0] >= hidden) break;
        k++;
    }
    const double *from = row_of(h, k), *to = k + 1 < h->count ? row_of(h, k + 1) : from;
    const double span = to[0] - from[0], share = span > 0.0 && t > from[0] ? (t < to[0] ? (t - from[0]) / span : 1.0) : 0.0;
    for (int j = 1; j < ROW; j++) out[j - 1] = from[j] + share * (to[j] - from[j]);
}

/* Whether two rows differ by more than the rounding of a host that interpolates. */
static int is_jump(const double *from, const double *to)
{
    if (from[0] != to[0]) return 0;
    for (int j = 1; j < ROW; j++)
        if (fabs(to[j] - from[j]) > 1e-9 * (1.0 + fabs(from[j]))) return 1;
    return 0;
}

/* Time of the first jump after a time; infinity without one. */
static double next_jump(const History *h, double t)
{
    for (size_t k = 0; k + 1 < h->count; k++)
        if (row_of(h, k)[0] > t && is_jump(row_of(h, k), row_of(h, k + 1))) return row_of(h, k)[0];
    return HUGE_VAL;
}
