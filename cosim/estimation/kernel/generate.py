"""Generation of kernel functions: derivative, Jacobian, outputs and shaping of commands.

The model is evaluated symbolically with all effects and sensor errors active, so that one compiled kernel serves every
candidate; the neutral value switches an effect off. Each forced equation has an unknown input d, a zero-mean
Gauss-Markov process with correlation time T, which the filter estimates:

    ẋ = f(x, u) + d      ḋ = −d/T + w

A parameter with a value per log can be a constant state, θ̇ = 0, whose value is known or estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

import cosim.fmi.native
from cosim.core.units import unit_of_rate
from cosim.estimation.kernel.kernel import (
    CONSTANT_PREFIX,
    CORRELATION_TIME,
    DEVIATION,
    DISTURBANCE,
    EARLIER,
    START_PREFIX,
    Layout,
)
from cosim.files.cache import fingerprint, load_or_make
from cosim.model.model import STIFF, Model
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import Quantity, parameters_of
from cosim.model.symbolic.functions import Body
from cosim.model.symbolic.languages import C
from cosim.model.symbolic.symbols import SymbolicModel, number_guard
from cosim.terms.code import FmuModel
from cosim.terms.language import Force, RateTerm

Generated = tuple[Layout, str]  # layout of the arrays, and C source of a filter
FOLDER = Path(__file__).parent
NATIVE = Path(cosim.fmi.native.__file__).parent


def generate(model: Model, measured: Sequence[str], unnamed: bool = False, constant: Sequence[str] = ()) -> Generated:
    """Return the layout and the C source of the filter for a model and measured outputs.

    Generated functions are `deriv(t, x, u, p, dx)`, `jacobian(t, x, u, p, A)`, `measure(t, x, u, p, y)`,
    `measure_jacobian(t, x, u, p, C)` and `shape_all(h, u, memory, p, out)`; A and C contain only stochastic states. For
    a stiff integrator, `state_jacobian(t, x, u, p, J)` contains all states.

    Args:
        unnamed: Add terms outside the catalogue (unmodelled dynamics) to each forced equation: `unnamed.state.basis`, a
            coefficient times a basis function of a signal, and local shapes.
        constant: Parameters that become states with derivative 0. Shaping of commands still uses their values in `p`.
    """
    import sympy
    from sympy import srepr

    body, (forced, uncertain, drifting, driven) = Body.of(model), _reach(model, measured)
    equal = {symbol: q.name for q, symbol in zip(body.symbols.model.states, body.symbols.state, strict=False)}
    rates = {name: equal[e] for name, e in body.derivative.items() if e in equal}
    shapes: list[LocalShape] = []
    if unnamed:
        sums, shapes = _nameless(body, Known.of(body.symbols, excluded=drifting), forced, measured)
        body.derivative.update({state: body.derivative[state] + sums[state] for state in forced})
    _add_sensor_errors(body, model)
    if unnamed:
        body.outputs.update({n: sympy.sympify(body.outputs[n]) + sums[READING_PREFIX + n] for n in measured})
    if forced:  # an unknown input as additional state in each forced equation
        lasting = body.parameter(CORRELATION_TIME)
        added = {name: sympy.Symbol(f"state:{DISTURBANCE}{name}", real=True) for name in forced}
        for name, d in added.items():
            body.derivative[name] += d
            body.derivative[DISTURBANCE + name] = -d / lasting
        body = replace(body, symbols=replace(body.symbols, state=(*body.symbols.state, *added.values())))
    body, carrying = _with_constants(body, driven, measured, constant)
    names, unknown = list(body.derivative), [DISTURBANCE + n for n in forced]
    random = (*uncertain, *unknown, *carrying, *(CONSTANT_PREFIX + n for n in constant))
    stochastic = tuple(names.index(n) for n in random)
    x = [body.symbols.state[k] for k in stochastic]
    f, g = [body.derivative[n] for n in names], [sympy.sympify(body.outputs[n]) for n in measured]
    symbols, shaping, library = body.symbols, body.shaping, _library_inputs(body)
    local = [(s.factor, s.shape, s.sums, s.values, s.slopes) for s in shapes]
    key = srepr([f, g, x, body.parameters, list(symbols.state), list(symbols.command), symbols.time, library])
    key += srepr([shaping.stages, shaping.results, shaping.remembered, local, body.terms])
    stiff = model.integrator == STIFF
    version = (stochastic, stiff, fingerprint(("cosim.model.symbolic", "cosim.estimation.kernel", "cosim.terms")))

    def print_functions() -> str:
        random = _slopes([f[i] for i in stochastic], x, shapes)
        functions = {"deriv": f, "jacobian": random, "measure": g, "measure_jacobian": _slopes(g, x, shapes)}
        if stiff:
            functions["state_jacobian"] = _slopes(f, symbols.state, shapes)
        texts = [body.function(C(), name, e, _stages(shapes)) for name, e in functions.items()]
        return "\n".join((*texts, body.shaping_function(C(), "shape_all")))

    text: str = (_shape_functions() if unnamed else "") + load_or_make(f"{version} {key}", print_functions)
    if library:
        text += body.function(C(), "library_inputs", library)
    layout = _layout(
        body,
        measured,
        states=tuple(names),
        stochastic=stochastic,
        noisy=tuple(range(len(uncertain), len(uncertain) + len(unknown))),
        driven=tuple(names.index(n) for n in driven),
        carrying=tuple(names.index(n) for n in carrying),
        rates=rates,
    )
    counts = {"NB": len(model.base_states), "NL": len(model.outputs)} if isinstance(model, FmuModel) else {}
    files = "library_calls.c", "library.c"
    return layout, _source(layout, text, {"STIFF": int(stiff), **counts}, files if counts else (), "filter.c")


def generate_stepped(model: FmuModel, measured: Sequence[str], unnamed: bool = False) -> Generated:
    """Return the layout and the C source of the filter for free runs of an FMU for co-simulation.

    Random states are: deviations of the outputs in the previous row; an unknown input of each output; deviations of the
    outputs, driven by these inputs; start states, which are constant.

    Args:
        unnamed: Add terms outside the catalogue to each unknown input: `add_unnamed(t, x, u, p, out)`, where x contains
            the measured outputs, then their rates.
    """
    import sympy

    body = Body.of(model)
    known = Known.of(body.symbols, measured)
    _add_sensor_errors(body, model)
    body.parameter(CORRELATION_TIME)
    sums, shapes = _nameless(body, known, measured) if unnamed else ({}, [])
    names = [q.name for q in model.outputs]
    values = [sympy.sympify(body.outputs[n]) for n in measured]
    texts = [body.function(C(), "measure", values), body.shaping_function(C(), "shape_all")]
    texts.append(body.function(C(), "library_inputs", _library_inputs(body)))
    if unnamed:
        near = {q.name: symbol for q, symbol in known.states}
        x = [near.get(prefix + n, sympy.Symbol(f"no {prefix}{n}")) for prefix in ("", RATE) for n in measured]
        of_outputs = replace(body, symbols=replace(body.symbols, state=tuple(x)))
        texts += [_shape_functions(), of_outputs.function(C(), "add_unnamed", [*sums.values()], _stages(shapes))]
    # parameter → neutral value, for terms that depend on a position or level; names of these positions and levels
    m, at, speed = SymbolNamespace(), sympy.Symbol("position", real=True), sympy.Symbol("velocity", real=True)
    along, places = dict[str, float](), dict[str, None]()
    for kind in model.catalogue:
        if not issubclass(kind, (Force, RateTerm)):
            continue
        declared = parameters_of(kind)
        term = kind(**{p.name: sympy.Symbol(f"p:{p.name}", real=True) for p in declared})
        with number_guard(smooth=True):
            force = sympy.sympify(term.force(m, at, speed) if isinstance(term, Force) else term.rate(m, at))
        if at in force.free_symbols:
            along |= {f"{kind.name}.{p.name}": p.neutral for p in declared if p.neutral is not None}
            place = kind.place.position if issubclass(kind, Force) else kind.place.state
            places[model.outputs[place].name] = None
    prefixes = (EARLIER, DISTURBANCE, DEVIATION)
    states = (*names, *(prefix + n for prefix in prefixes for n in measured), *(START_PREFIX + n for n in model.starts))
    layout = _layout(
        body,
        measured,
        states=states,
        stochastic=tuple(range(len(names), len(states))),
        noisy=tuple(range(len(measured), 2 * len(measured))),
        rates=known.rates,
        is_free_run=True,
        along=along,
        positions=tuple(measured.index(n) for n in places if n in measured),
    )
    positions = layout.positions
    run_places = [names.index(measured[k]) for k in positions]
    sizes = {
        **{"NB": len(names), "NL": len(names), "STIFF": 0, "UNNAMED": int(unnamed)},
        **{"LASTING": layout.parameters.index(CORRELATION_TIME), "POSITIONS": len(positions)},
        **{"READ_PLACES": positions, "RUN_PLACES": run_places},
    }
    return layout, _source(layout, "\n".join(texts), sizes, ("library_calls.c", "stepped_library.c"), "free_run.c")


def _source(layout: Layout, functions: str, more: Mapping[str, Any], before: Sequence[str], filter: str) -> str:
    """Return the C source of a filter: sizes, generated functions and hand-written code.

    Args:
        more: Further sizes and indices.
        before: C files to include before the generated functions.
        filter: C file with the filter.
    """
    groups = {"NX": layout.states, "NU": layout.inputs, "NY": layout.outputs, "NS": layout.stochastic}
    sizes: dict[str, Any] = {name: len(group) for name, group in groups.items()}
    sizes |= {"NM": layout.memory, "DELAY": f"({layout.delay})", "STEPPED": int(layout.is_free_run)}
    sizes |= {"STOCHASTIC": layout.stochastic, **more}
    texts = {n: v if isinstance(v, (int, str)) else f"{{{', '.join(map(str, v or (0,)))}}}" for n, v in sizes.items()}
    head = "".join(f"#define {name} {text}\n" for name, text in texts.items())
    first, last = (
        [path.read_text(encoding="utf-8") for path in paths]
        for paths in ([FOLDER / name for name in before], [NATIVE / "step.c", FOLDER / "lags.c", FOLDER / filter])
    )
    return "\n".join(("#include <math.h>", head, *first, functions, *last))


def _library_inputs(body: Body) -> list[Any]:
    """Return the inputs of an FMU's library as expressions; empty for a model with equations of its own."""
    import sympy

    s = body.symbols
    if not isinstance(s.model, FmuModel):
        return []
    with number_guard(smooth=True):
        return [sympy.sympify(e) for e in s.model.library_inputs(SymbolNamespace(), s.state, s.command)]


def _layout(body: Body, measured: Sequence[str], **more: Any) -> Layout:
    inputs = tuple(q.name for q in body.symbols.model.inputs)
    memory = len(body.shaping.remembered)
    return Layout(
        tuple(body.parameters), inputs=inputs, outputs=tuple(measured), memory=memory, delay=body.delay, **more
    )


def _nameless(
    body: Body, known: Known, forced: Sequence[str], measured: Sequence[str] = ()
) -> tuple[dict[str, Any], list[LocalShape]]:
    """Return the unmodelled dynamics of forced equations and readings, and local shapes; parameters are added.

    Readings have local shapes only.
    """
    import sympy

    places = [*forced, *(READING_PREFIX + n for n in measured)]
    sums: dict[str, Any] = dict.fromkeys(places, sympy.Integer(0))
    for name, basis in bases(known).items():
        for state in forced:
            sums[state] += body.parameter(f"{SHAPE_PREFIX}.{state}.{name}") * basis
    signals = local_signals(known)
    shapes = [local_shape(slot, signals, places, body.parameter) for slot in range(1, SLOTS + 1)]
    for shape in shapes:
        for place, term in zip(places, shape.terms, strict=True):
            sums[place] += term
    return sums, shapes


def _shape_functions() -> str:
    """Return the text of the C functions of local shapes."""
    return f"#define KNOTS {KNOTS}\n" + (FOLDER / "local_shape.c").read_text(encoding="utf-8")


def _stages(shapes: Sequence[LocalShape]) -> list[dict[Any, Any]]:
    """Return the stages in which printed code computes all local shapes."""
    stages = zip(*((s.sums, s.values) for s in shapes), strict=True)
    return [dict(chain.from_iterable(s.items() for s in stage)) for stage in stages]


def _slopes(rows: Sequence[Any], states: Sequence[Any], shapes: Sequence[LocalShape]) -> list[Any]:
    """Return the derivative of each expression by each state, including paths through local shapes."""
    import sympy

    slopes = []
    for row in rows:
        symbols = row.free_symbols
        through = [(sympy.diff(row, s.factor), sympy.diff(row, s.shape), s.slopes) for s in shapes]
        for by in states:
            slope = sympy.diff(row, by) if by in symbols else sympy.Integer(0)
            for by_factor, by_shape, inner in through:
                if by in inner:
                    of_factor, of_shape = inner[by]
                    slope += by_factor * of_factor + by_shape * of_shape
            slopes.append(slope)
    return slopes


def _add_sensor_errors(body: Body, model: Model) -> None:
    import sympy

    true = dict(body.outputs)
    for kind in model.sensors:
        symbol = body.parameter(f"{kind.name}.value")
        if kind.depends_on_past():
            continue  # the filter accounts for latency and lag
        outputs = true | {name: body.outputs[name] for name in kind.affected()}
        with number_guard(smooth=True):
            readings = kind(value=symbol).readings(SymbolNamespace(), body.symbols.time, outputs)
        body.outputs.update({name: sympy.sympify(e) for name, e in readings.items()})


def _with_constants(
    body: Body, driven: Sequence[str], measured: Sequence[str], constant: Sequence[str]
) -> tuple[Body, tuple[str, ...]]:
    """Return the equations with parameters as constant states, and the states that these make uncertain."""
    import sympy

    if not constant:
        return body, ()
    states = {body.parameters[n]: sympy.Symbol(f"state:{CONSTANT_PREFIX}{n}", real=True) for n in constant}
    body.derivative.update({n: e.xreplace(states) for n, e in body.derivative.items()})
    body.outputs.update({n: sympy.sympify(e).xreplace(states) for n, e in body.outputs.items()})
    places = [k for k, e in enumerate(body.derivative.values()) if e.free_symbols & set(states.values())]
    reached, reaching = _influence(body, places, [body.outputs[n] for n in measured])
    # base states that only an effect couples are excluded, as for process noise
    apart = {q.name for q in body.symbols.model.base_states} - {*driven}
    carrying = tuple(
        n
        for k, n in enumerate(body.derivative)
        if k in reached & reaching and not (n in apart or n.startswith(DISTURBANCE))
    )
    body.derivative.update({CONSTANT_PREFIX + n: sympy.Integer(0) for n in constant})
    return replace(body, symbols=replace(body.symbols, state=(*body.symbols.state, *states.values()))), carrying


def _reach(model: Model, measured: Sequence[str]) -> tuple[list[str], list[str], frozenset[str], list[str]]:
    """Return the states of the base model that process noise reaches or that influence a measured output.

    Effects are left out, so the filter's covariance ignores couplings that only effects cause.

    Returns:
        States with process noise and influence on a measured output; states that the noise reaches, with influence;
        states that the noise reaches, without influence; states that the noise does not reach, with influence.
    """
    body = Body.of(replace(model, effects=()), effects=False)
    names = list(body.derivative)
    forced = [names.index(n) for n in model.forced]
    outputs = [body.outputs[n] for n in measured]
    reached, reaching = _influence(body, forced, outputs)
    both = sorted(reached & reaching)
    return (
        [names[k] for k in forced if k in both],
        [names[k] for k in both],
        frozenset(names[k] for k in reached - reaching),
        [names[k] for k in sorted(reaching - reached)],
    )


def _influence(body: Body, first: Sequence[int], expressions: Sequence[Any]) -> tuple[set[int], set[int]]:
    """Return the indices of states that those in `first` influence, and of states that influence `expressions`."""
    symbols = [e.free_symbols for e in body.derivative.values()]
    depends = np.array([[x in of for x in body.symbols.state] for of in symbols], bool).reshape(len(symbols), -1)
    along = np.linalg.matrix_power(depends | np.eye(len(symbols), dtype=bool), len(symbols))  # paths of any length
    read = [any(x in e.free_symbols for e in expressions) for x in body.symbols.state]
    reached, reaching = along[:, list(first)].any(axis=1), along[read].any(axis=0)
    return {*np.flatnonzero(reached).tolist()}, {*np.flatnonzero(reaching).tolist()}


# Unmodelled dynamics in forced equations and readings: basis functions of one signal, and local shapes.
#
# Parameters define a local shape, so that one kernel serves every signal and range. With signals z,
#
#     to · (by.1 + by·z) · (Σ c_k·bump(ζ − k) + c·rise(ζ) + a·sin ζ + b·cos ζ)      ζ = of·z
#
# bump falls from 1 to 0 within ±2; rise increases from 0 to 1 between −1 and 1. With all parameters 0, the shape is 0.
#


READING_PREFIX = "reading of "  # prefix of an output in place of a state whose equation has a local shape
SHAPE_PREFIX = "unnamed"  # prefix of coefficients: `unnamed.state.basis`
RATE = "rate of "  # prefix of the rate of an output in co-simulation
LOCAL = "local"  # prefix of a local shape's parameters: `local.1.of.position`, and `local.1.of.1` of the constant
SLOTS, KNOTS = 2, 8  # simultaneous local shapes, and bumps of each
ROLES = ("of", "by")
BUMP_REACH = 2.0  # ζ at which a bump reaches 0


@dataclass(frozen=True)
class Known:
    """Signals on which unmodelled dynamics may depend, with their symbols.

    Attributes:
        states: States; for co-simulation, outputs and their rates.
        rates: State → state that equals its derivative.
    """

    time: Any
    states: Sequence[tuple[Quantity, Any]]
    commands: Sequence[tuple[Quantity, Any]]
    rates: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, s: SymbolicModel, measured: Container[str] | None = None, excluded: Container[str] = ()) -> Known:
        """Return the signals of a model.

        Args:
            measured: Outputs that replace states in co-simulation; by default all outputs.
            excluded: States that drift unobserved, on which no term can depend.
        """
        states = [(q, x) for q, x in zip(s.model.base_states, s.state, strict=False) if q.name not in excluded]
        rates: dict[str, str] = {}
        if isinstance(s.model, FmuModel) and s.model.stepped:
            import sympy

            states = [(q, x) for q, x in states if measured is None or q.name in measured]
            names, known = [q.name for q in s.model.base_states], {q.name for q, _ in states}
            rates = {names[k]: names[v] for k, v in s.model.rates.items() if {names[k], names[v]} <= known}
            for q in [q for q, _ in states if q.name not in {*rates, *rates.values()}]:
                rate = Quantity(f"{RATE}{q.name}", unit_of_rate(q.unit), f"rate of {q.doc or q.name}")
                states.append((rate, sympy.Symbol(f"state:{rate.name}", real=True)))
                rates[q.name] = rate.name
        return cls(s.time, states, [*zip(s.model.inputs, s.command, strict=True)], rates)


def bases(known: Known) -> dict[str, Any]:
    """Return name → basis function: the constant, and functions of time, a state, a velocity, an angle or a command."""
    import sympy

    functions: dict[str, Any] = {"1": sympy.Integer(1), "time": known.time}
    inputs = {q.name for q, _ in known.commands}
    for q, x in known.states:
        functions[q.name] = x
        if q.unit in {"m/s", "rad/s"}:
            functions[f"{q.name}·|{q.name}|"] = x * sympy.sqrt(x * x)
            functions[f"{q.name}³"] = x**3
            functions[f"|{q.name}|"] = sympy.sqrt(x * x)
            functions[f"{q.name} where positive"] = (x + sympy.sqrt(x * x)) / 2
            functions[f"{q.name} where negative"] = (x - sympy.sqrt(x * x)) / 2
            functions[f"time·{q.name}"] = known.time * x
        if q.unit == "rad" and q.name not in inputs:
            functions |= {
                f"sin {q.name}": sympy.sin(x),
                f"cos {q.name}": sympy.cos(x),
                f"cos 2{q.name}": sympy.cos(2 * x),
            }
    for q, u in known.commands:
        functions[f"command {q.name}"] = u
        if q.unit == "rad":
            functions[f"command {q.name}·|{q.name}|"] = u * sympy.sqrt(u * u)
    return functions


def local_signals(known: Known) -> dict[str, Any]:
    """Return name → signal on which local shapes can depend: time, states, sine and cosine of angles, commands."""
    import sympy

    signals = {"time": known.time} | {q.name: x for q, x in known.states}
    for q, x in known.states:
        if q.unit == "rad":
            signals |= {f"cos {q.name}": sympy.cos(x), f"sin {q.name}": sympy.sin(x)}
    return signals | {f"command {q.name}": u for q, u in known.commands}


@dataclass(frozen=True)
class LocalShape:
    """Symbols of a local shape: unmodelled dynamics in a range of a signal, factor times shape.

    Attributes:
        terms: State or reading → contribution to its equation or reading.
        sums: Symbol of ζ and of the factor → expression.
        values: Symbols of the shape and of its derivative by ζ → call of a C function.
        slopes: Symbol of a signal → derivatives of factor and shape.
    """

    factor: Any
    shape: Any
    terms: tuple[Any, ...]
    sums: dict[Any, Any]
    values: dict[Any, Any]
    slopes: dict[Any, tuple[Any, Any]]


def local_shape(
    slot: int, signals: dict[str, Any], equations: Sequence[str], number: Callable[[str], Any]
) -> LocalShape:
    """Return a local shape and its derivatives by states.

    Args:
        slot: Number of the shape, which is part of its parameters' names.
        number: Function from a parameter's name to its symbol.
    """
    import sympy

    from cosim.model.symbolic import printed

    def symbol(name: str) -> Any:
        return sympy.Symbol(f"{LOCAL}{slot}_{name}", real=True)

    weights = {role: {z: number(f"{LOCAL}.{slot}.{role}.{n}") for n, z in signals.items()} for role in ROLES}

    def slope(role: str, x: Any) -> Any:
        return sum(w * sympy.diff(z, x) for z, w in weights[role].items() if x in z.free_symbols)

    over, factor, shape, bend = map(symbol, ("over", "factor", "shape", "bend"))
    coefficients = [number(f"{LOCAL}.{slot}.{name}") for name in ("rise", *range(KNOTS), "sin", "cos")]
    sums = {role: sum(w * z for z, w in of.items()) for role, of in weights.items()}
    return LocalShape(
        factor,
        shape,
        tuple(number(f"{LOCAL}.{slot}.to.{name}") * factor * shape for name in equations),
        {over: number(f"{LOCAL}.{slot}.of.1") + sums["of"], factor: number(f"{LOCAL}.{slot}.by.1") + sums["by"]},
        {shape: printed.LocalShape(over, coefficients[0]), bend: printed.LocalSlope(over, coefficients[0])},
        {x: (slope("by", x), bend * slope("of", x)) for x in signals.values() if x.is_Symbol},
    )


def bump(x: Any) -> Any:
    """Return (1 − x²/4)³ where positive, for arrays or symbols."""
    below = 1 - x * x / BUMP_REACH**2
    return ((below + abs(below)) / 2) ** 3


def rise(x: Any) -> Any:
    """Return a smooth step in x: 0 below −1, 1 above 1, and a cubic between."""
    c = (abs(x + 1) - abs(x - 1)) / 2  # x limited to −1 … 1
    return (2 + 3 * c - c**3) / 4
