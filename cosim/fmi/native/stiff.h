/* A linearly implicit Runge-Kutta method for stiff equations: RODAS, of order 4, L-stable; rosenbrock.py is the same in Python.
 *
 *   (I/(h gamma) - J) k_i = f(t + alpha_i h, x + sum a_ij k_j) + sum c_ij k_j/h + gamma_i h f',   x(t + h) = x + sum a_6j k_j + k_6
 *
 * with J = df/dx at the start of the step and f' the slope of f in time alone. Hairer, Wanner: Solving Ordinary Differential
 * Equations II, section IV.7. Defined above this text: MOST, the largest number of states. */
#define STAGES 6

typedef struct {
    double a[MOST * MOST + 1]; /* L below the diagonal, U on and above it */
    int row[MOST + 1];
} Factored;

/* The derivative k of x; share: part of the step at which the command is taken. */
typedef void (*Rates)(const void *of, double t, double share, const double *x, double *k);

/* Factor I/(h gamma) - J, slopes at a kink left out; 1 if it is singular. */
static int factor(int n, double h, const double *J, Factored *f)
{
    double *a = f->a;
    for (int i = 0; i < n * n; i++) a[i] = (i % (n + 1) == 0 ? 1.0 / (h * 0.25) : 0.0) - (isfinite(J[i]) ? J[i] : 0.0);
    for (int i = 0; i < n; i++) f->row[i] = i;
    for (int c = 0; c < n; c++) {
        int pivot = c;
        for (int i = c + 1; i < n; i++) if (fabs(a[i * n + c]) > fabs(a[pivot * n + c])) pivot = i;
        if (!(fabs(a[pivot * n + c]) > 0.0)) return 1;
        for (int j = 0; j < n; j++) {
            const double s = a[c * n + j];
            a[c * n + j] = a[pivot * n + j], a[pivot * n + j] = s;
        }
        const int r = f->row[c];
        f->row[c] = f->row[pivot], f->row[pivot] = r;
        for (int i = c + 1; i < n; i++) {
            const double share = a[i * n + c] /= a[c * n + c];
            for (int j = c + 1; j < n; j++) a[i * n + j] -= share * a[c * n + j];
        }
    }
    return 0;
}

static void solve(int n, const Factored *f, const double *b, double *x)
{
    const double *a = f->a;
    for (int i = 0; i < n; i++) {
        x[i] = b[f->row[i]];
        for (int j = 0; j < i; j++) x[i] -= a[i * n + j] * x[j];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int j = i + 1; j < n; j++) x[i] -= a[i * n + j] * x[j];
        x[i] /= a[i * n + i];
    }
}

static void stiff_step(int n, const Factored *f, double t, double h, double *x, Rates rates, const void *of)
{
    static const double alpha[STAGES] = {0.0, 0.386, 0.21, 0.63, 1.0, 1.0};
    static const double gamma[STAGES] = {0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0};
    static const double a[STAGES][STAGES] = {
        {0.0},
        {1.544},
        {0.9466785280815826, 0.2557011698983284},
        {3.314825187068521, 2.896124015972201, 0.9986419139977817},
        {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895},
        {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895, 1.0},
    };
    static const double c[STAGES][STAGES] = {
        {0.0},
        {-5.6688},
        {-2.430093356833875, -0.2063599157091915},
        {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
        {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.7089089320616},
        {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054},
    };
    double k[STAGES][MOST + 1], at[MOST + 1], right[MOST + 1], drift[MOST + 1], middle[MOST + 1], last[MOST + 1];
    rates(of, t, 0.0, x, right);
    rates(of, t + 0.5 * h, 0.5, x, middle);
    rates(of, t + h, 1.0, x, last);
    for (int m = 0; m < n; m++) drift[m] = (4.0 * (middle[m] - right[m]) - (last[m] - right[m])) / h;
    for (int i = 0; i < STAGES; i++) {
        for (int m = 0; m < n; m++) {
            double sum = 0.0;
            for (int j = 0; j < i; j++) sum += a[i][j] * k[j][m];
            at[m] = x[m] + sum;
        }
        rates(of, t + alpha[i] * h, alpha[i], at, right);
        for (int m = 0; m < n; m++) {
            double sum = 0.0;
            for (int j = 0; j < i; j++) sum += c[i][j] * k[j][m];
            right[m] += sum / h + gamma[i] * h * drift[m];
        }
        solve(n, f, right, k[i]);
    }
    for (int m = 0; m < n; m++) x[m] = at[m] + k[STAGES - 1][m];
}
