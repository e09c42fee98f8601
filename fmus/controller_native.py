"""The controller as C: its design by the same functions, evaluated with symbols and printed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from controller.design_model import design_model, fix_matrix, measurement_matrix
from controller.gains import ESTIMATORS, Settings
from controller.kalman import discrete_model
from cosim.fmi.native.layout import Layout
from cosim.fmi.native.package import Native, part
from cosim.fmi.native.printing import LANGUAGE, Sources, quoted, variable_tables
from cosim.model import parameters_of
from fmus.craft_ports import ESTIMATE
from fmus.recipes import controller_recipe

STATES, COMMANDS, MEASURED, FIXED = len(ESTIMATE), 2, 3, 1
NAMES = """
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
"""
DESIGN = """
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
"""


def controller_native() -> Native:
    """What makes the native controller."""
    recipe = controller_recipe()
    ports = recipe.about.ports
    tables, texts = variable_tables(ports)
    place = {port.name: k for k, port in enumerate(ports)}
    sizes = {
        "VARIABLES": len(ports),
        "TEXTS": texts,
        "INPUTS": sum(p.causality == "input" for p in ports),
        "OUTPUTS": sum(p.causality == "output" for p in ports),
        "STATES": 0,
        "MEMORIES": 0,
        "KINKS": 0,
        "RANGES": 0,
        "EFFECTS": 0,
        # x̂, P, u, last fix, then F, G, H, V, W, L, limit and sample time, H and W of a fix
        "OWN": (STATES + STATES**2 + COMMANDS + 1)
        + (STATES * (STATES + COMMANDS + MEASURED + 1 + COMMANDS) + MEASURED + 2)
        + FIXED * (STATES + 1),
        "EXCHANGE": 0,
    }
    counts = {"states": STATES, "commands": COMMANDS, "measured": MEASURED, "fixed": FIXED}
    body = "".join((tables, DESIGN % counts, NAMES % place, _design(place)))
    return Native(
        "HovercraftController",
        Layout(recipe.about),
        Sources(body, sizes),
        {n: part(n) for n in ("filter.c", "steps_only.c")},
        recipe.text,
    )


def _design(place: dict[str, int]) -> str:
    """`design(m, d)`: each estimator's matrices from `discrete_model` and `measurement_matrix`, with symbols."""
    import sympy

    symbols = {p.name: sympy.Symbol(p.name, real=True) for p in parameters_of(Settings)}
    places = {symbol: f"p[{place[name]}]" for name, symbol in symbols.items()}
    settings = replace(Settings(), **symbols)
    lines = ["const double *p = m->values;", "const char *estimator = m->text[0];"]
    for k, estimator in enumerate(ESTIMATORS):
        own = replace(settings, estimator=estimator)
        lines.append(f"{'} else ' if k else ''}if (strcmp(estimator, {quoted(estimator)}) == 0) {{")
        lines += [f"    {line}" for line in (*_dynamics(own, places), *_matrix("d->H", _measured(own), places))]
    known = ", ".join(ESTIMATORS)
    lines.append(f'}} else return refuse(m, "estimator is %s; it is one of {known}", estimator);')
    lines += _matrix("d->L", settings.gain_matrix, places)
    lines += _vector("d->V", settings.process_variances, places)
    lines += _vector("d->W", settings.measurement_variances, places)
    lines += _matrix("d->fix_H", fix_matrix(settings), places)
    lines += _vector("d->fix_W", settings.fix_variances, places)
    lines += [f"d->limit = p[{place['tilt_max']}];", f"d->sample = p[{place['sample_time']}];", "return 0;"]
    return "\nstatic int design(Instance *m, Design *d)\n{\n" + "".join(f"    {line}\n" for line in lines) + "}\n"


def _dynamics(p: Settings, places: dict[Any, str]) -> Iterator[str]:
    """F and G: printed where they are an expression of the parameters, else of A and B, exact over the sample time."""
    if p.estimator == "appendix_f":
        F, G = discrete_model(p)
        yield from _matrix("d->F", F, places)
        yield from _matrix("d->G", G, places)
        return
    A, B = design_model(p)
    yield "double A[NX][NX], B[NX][NU];"
    yield from _matrix("A", A, places)
    yield from _matrix("B", B, places)
    yield f"hold({places[p.sample_time]}, A, B, d->F, d->G);"


def _measured(p: Settings) -> Any:
    return measurement_matrix(p, p.estimator)


def _matrix(name: str, rows: Any, places: dict[Any, str]) -> Iterator[str]:
    for k, row in enumerate(rows):
        yield from _vector(f"{name}[{k}]", row, places)


def _vector(name: str, values: Sequence[Any], places: dict[Any, str]) -> Iterator[str]:
    import sympy

    printer = LANGUAGE.printer(places)
    yield " ".join(f"{name}[{k}] = {printer.doprint(sympy.sympify(v))};" for k, v in enumerate(values))
