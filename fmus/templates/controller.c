
#define NX %(states)d
#define NU %(commands)d
#define NZ %(measured)d
#define NF %(fixed)d
#define EXP_SIZE (NX + NU)
#define SAMPLE_NAME "sample_time"

/* What the parameters say: the model that predicts, what is measured of it, noise, gain, limit, sample time, fixes. */
typedef struct {
    double F[NX][NX], G[NX][NU], H[NZ][NX], V[NX], W[NZ], L[NU][NX], limit, sample, fix_H[NF][NX], fix_W[NF];
} Design;

static void hold(double dt, double A[NX][NX], double B[NX][NU], double F[NX][NX], double G[NX][NU]);

static void measured(const Instance *m, double *z)
{
    z[0] = m->values[%(psi)d], z[1] = m->values[%(psi_dot)d], z[2] = m->values[%(ax)d];
}

/* The latest fix, and its number. */
static double fixed(const Instance *m, double *z)
{
    z[0] = m->values[%(x_meas)d];
    return m->values[%(fix)d];
}

/* Where it is to be: at rest at the distance and the heading of the references. */
static void reference(const Instance *m, double *x)
{
    x[0] = m->values[%(x_ref)d], x[1] = 0.0, x[2] = m->values[%(psi_ref)d], x[3] = 0.0, x[4] = 0.0;
}

static void start(const Instance *m, double *x)
{
    for (int i = 0; i < NX; i++) x[i] = m->values[%(x_hat_start)d + i];
}

static void publish(const Instance *m, const double *u, const double *x, const double *variance, double *y)
{
    y[0] = y[1] = m->values[%(duty_nominal)d];
    y[2] = u[0], y[3] = u[1];
    for (int i = 0; i < NX; i++) y[4 + i] = x[i];
    y[9] = sqrt(fmax(0.0, variance[0])), y[10] = sqrt(fmax(0.0, variance[2]));
}
