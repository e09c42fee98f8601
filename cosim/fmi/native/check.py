"""Check of generated C against a model's Python at seeded random points, before compilation.

Tracing records one path through the equations. A model whose path depends on run-time values (a look-up in a
dictionary, a test for effects) gives wrong C code. A comparison of both evaluations detects such models.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np

from cosim.fmi.native.printing import ModelPrinter
from cosim.model.integrate import Stepper
from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SCALAR
from cosim.model.quantities import Parameter, parameters_of
from cosim.model.symbolic.blocks import function
from cosim.model.symbolic.languages import Python
from cosim.model.symbolic.trace import Trace, UnprintableModel

PEER_TOLERANCE = 1e-9  # of max(1, |value|)
POINTS, TRIES = 6, 18  # points per case, and draws if Python gives no number
CURE = (
    "the equations contain a decision that symbols cannot express (a look-up in a dictionary, int() or a branch on a "
    "number): use m.where; or they test for effects: C code evaluates every effect, so an effect at its neutral value "
    "must not change them"
)


@dataclass(frozen=True)
class EvaluationPoint:
    """Arguments of an evaluation: states x, inputs u, memory (of dormant effects, too), parameters by FMI name."""

    t: float
    h: float
    x: Sequence[float]
    u: Sequence[float]
    memory: Sequence[float]
    values: Mapping[str, float | bool]


def check(model: Model, printer: ModelPrinter) -> None:
    """Compare Python and generated code, without effects, with each effect and with all.

    Raises:
        UnprintableModel: They differ; the error has the first difference and the cure.
    """
    uniform, kinds = random.Random(0).uniform, model.catalogue
    flags = product((False, True), repeat=len(printer.switches))
    variants = [(dict(zip(printer.switches, f, strict=True)), t) for f, t in zip(flags, printer.variants, strict=True)]
    codes = [(switches, generated_code(trace)) for switches, trace in variants]
    for awake, (switches, code) in product(dict.fromkeys([(), *((kind,) for kind in kinds), kinds]), codes):
        names, count = {e.name for e in awake}, 0
        for k in range(TRIES):
            at = draw_point(model, printer, awake, switches, k, uniform)
            try:
                python = [(name, hook, float(value)) for name, hook, value in evaluate(model, printer, names, at)]
                generated = code(at, names)
            except (ArithmeticError, ValueError, TypeError):  # The model has no real value at this point.
                continue
            for (quantity, hook, value), other in zip(python, generated, strict=True):
                if math.isfinite(value) and not abs(value - other) <= PEER_TOLERANCE * max(1.0, abs(value)):
                    active = ", ".join([*sorted(names), *(n for n, on in switches.items() if on)]) or "no effect"
                    both = f"{value:.9g} in Python, {other:.9g} in the generated C code"
                    text = f"{quantity} differs: {both} (active: {active})"
                    if len(awake) == 1:
                        raise UnprintableModel(text, awake[0], "" if hook == "equations" else hook, CURE)
                    raise UnprintableModel(text, type(model), "equations", CURE)
            count += 1
            if count == POINTS:
                break


def generated_code(trace: Trace) -> Callable[[EvaluationPoint, set[str]], list[float]]:
    """Return the generated equations, printed as Python instead of C, as a function of a point and active effects.

    Its result has derivatives, outputs, changed command, new memory and memory at the start, as in `evaluate`.
    """
    parameters, effects = list(trace.s.parameters), [e.name for e in trace.effects]
    places = trace.places({name: k for k, name in enumerate(parameters)})
    functions = (
        ("derivatives", "t x u p", trace.blocks, trace.derivative),
        ("outputs", "t x u p", trace.blocks, trace.outputs),
        ("shape", "t h u memory p", trace.shaping, [*trace.shaped, *trace.remembered]),
        ("remember", "t memory p", (), trace.started),
    )
    # functions of numpy, because they give NaN or infinity like C, where those of `math` raise exceptions
    scope: dict[str, Any] = {"math": SimpleNamespace(**{**vars(math), **vars(np)})}
    for name, arguments, blocks, results in functions:
        exec(function(Python(), name, arguments, blocks, results, places), scope)

    def evaluated(at: EvaluationPoint, awake: set[str]) -> list[float]:
        numbers = {**vars(at), "p": [at.values[n] for n in parameters]}
        values: list[float] = []
        for name, arguments, _, results in functions:
            out, ordered = [math.nan] * len(results), (numbers[argument] for argument in arguments.split())
            cells = [np.float64(v) if isinstance(v, float) else [*map(np.float64, v)] for v in ordered]
            with np.errstate(all="ignore"):
                scope[name](*cells, [n in awake for n in effects], out)
            values += map(float, out)
        return values

    return evaluated


def evaluate(
    model: Model, printer: ModelPrinter, names: set[str], at: EvaluationPoint
) -> Iterator[tuple[str, str, float]]:
    """Yield quantity, method of the model and value, in the order of the generated functions, by Python.

    The memory of a dormant effect is NaN. Delays are skipped, because their C code is not generated.
    """
    base = {n: v for n, v in at.values.items() if "." not in n or n.partition(".")[0] in names}
    stepper = Stepper(replace(model, effects=()).with_values(base))
    states = [q.name for q in printer.states]
    acting = [q.name for q in stepper.model.states]
    state, command = tuple(at.x[states.index(name)] for name in acting), tuple(at.u)
    rates = dict.fromkeys(states, 0.0) | dict(zip(acting, stepper.derivative(at.t, state, command), strict=True))
    yield from ((f"der({name})", "equations", rate) for name, rate in rates.items())
    outputs = zip(model.outputs, stepper.output(at.t, state, command), strict=True)
    yield from ((q.name, "equations", value) for q, value in outputs)
    remembered, started, place = list[tuple[str, str, float]](), list[tuple[str, str, float]](), 0
    awake = {e.name: e for e in stepper.model.awake}
    for effect in overrides(printer.trace.effects, "shape", Effect):
        if effect.delay:
            continue
        own = tuple(at.memory[place : place + len(effect.memory)])
        place += len(own)
        after = start = (math.nan,) * len(own)
        if active := awake.get(effect.name):
            start = active.remember(at.t, own)
            command, after = active.shape(SCALAR, at.t, at.h, command, own)
        quantities = [f"{effect.name}.{q.name} in memory" for q in effect.memory]
        remembered += zip(quantities, ["shape"] * len(own), after, strict=True)
        started += zip(quantities, ["remember"] * len(own), start, strict=True)
    yield from ((f"{q.name} after all effects", "shape", v) for q, v in zip(model.inputs, command, strict=True))
    yield from (*remembered, *started)


def draw_point(
    model: Model,
    printer: ModelPrinter,
    awake: Sequence[type[Effect]],
    switches: Mapping[str, bool],
    k: int,
    uniform: Callable[[float, float], float],
) -> EvaluationPoint:
    """Return the random point of draw k.

    The first points have the model's parameter values. From draw POINTS on, points approach the start values.
    """
    size = 10.0 ** min(0, POINTS - k - 1)

    def near(value: float) -> float:
        return value + size * uniform(-1, 1) * max(1.0, abs(value))

    def scaled(p: Parameter, value: Any) -> Any:
        if isinstance(value, bool) or k % POINTS == 0:
            return value
        return min(p.bounds[1], max(p.bounds[0], value * uniform(0.8, 1.2)))

    values = {p.name: scaled(p, getattr(model, p.name)) for p in model.parameters}
    for kind in model.catalogue:
        for p in parameters_of(kind):
            value = p.default  # the neutral value, if the parameter has one
            if p.neutral is not None and kind in awake:
                gap = min(1.0, p.bounds[1] - p.neutral) / 2.0
                value = p.typical or p.neutral + (gap if gap > 0.0 else -1.0)
            values[f"{kind.name}.{p.name}"] = value if value == p.neutral else scaled(p, value)
        for name, smaller in kind.at_least.items() if kind in awake else ():
            key = f"{kind.name}.{name}"
            values[key] = max(values[key], values[f"{kind.name}.{smaller}"])
    starts = dict(zip((q.name for q in model.states), model.start(), strict=True))
    memory = [near(q.start) for _, q in printer.remembering]
    state = [near(float(starts.get(q.name, q.start))) for q in printer.states]
    command = [near(float(v)) for v in model.start_command()]
    substep = model.substep * uniform(0.1, 1.0)
    return EvaluationPoint(uniform(0.0, 10.0), substep, state, command, memory, {**values, **switches})
