/* Whether a sample lies within the region of the logs: some point of the region is nearer than the threshold in every
 * coordinate. The same rule as `distances` of region.py, which finds the nearest point. The printed tables are above. */

/* Of earlier samples: a point near one, tried first; and one that was outside, with a lower bound of its distance. */
typedef struct {
    size_t nearest;
    double outside[COORDINATES], bound;
} Judged;

static int is_inside(const double *begin, const double *end, double span, Judged *judged)
{
    double sample[COORDINATES], shift = 0.0, bound = HUGE_VAL;
    int farthest = 0; /* coordinate in which the last point was too far, tried first */
    for (int k = 0; k < COORDINATES; k++) {
        const int signal = REGION_SIGNAL[k];
        const double value = REGION_IS_RATE[k] ? (end[signal] - begin[signal]) / span : begin[signal];
        sample[k] = (value - REGION_LOW[k]) / REGION_SCALE[k];
        if (!isfinite(sample[k])) return 0;
        const double moved = fabs(sample[k] - judged->outside[k]);
        shift = moved > shift ? moved : shift;
    }
    if (judged->bound - shift > 1.000001 * REGION_THRESHOLD) return 0;
    for (size_t trial = 0; trial <= REGION_POINTS; trial++) {
        const size_t point = trial == 0 ? judged->nearest : trial - 1;
        double apart = fabs(sample[farthest] - REGION_POINT[farthest * REGION_POINTS + point]);
        for (int k = 0; k < COORDINATES && apart <= REGION_THRESHOLD; k++) {
            apart = fabs(sample[k] - REGION_POINT[k * REGION_POINTS + point]);
            farthest = k;
        }
        if (apart <= REGION_THRESHOLD) {
            judged->nearest = point;
            return 1;
        }
        bound = apart < bound ? apart : bound;
    }
    memcpy(judged->outside, sample, sizeof sample);
    judged->bound = bound;
    return 0;
}
