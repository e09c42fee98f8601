"""Check of generated C against a model's Python at seeded random points, before compilation.

Tracing records one path through the equations. A model whose path depends on run-time values (a look-up in a
dictionary, a test for effects) gives wrong C code. A comparison of both evaluations detects such models.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
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
DECIDED = (
    "the equations contain a decision that symbols cannot express (a look-up in a dictionary, int() or a branch on a "
    "number): use m.where"
)
NOT_NEUTRAL = (
    "the effect changes the equations even at its neutral value, or the equations test for effects: C code "
    "evaluates every effect, so an absent effect must be neutral"
)
Values = list[tuple[str, str, float]]  # quantity, method of the model, value
Difference = tuple[str, str, float, float]  # quantity, method of the model, value by Python, value by generated code


@dataclass(frozen=True)
class EvaluationPoint:
    """Arguments of an evaluation: states x, inputs u, memory (of dormant effects, too), parameters by FMI name."""

    t: float
    h: float
    x: Sequence[float]
    u: Sequence[float]
    memory: Sequence[float]
    values: Mapping[str, float | bool]


class GeneratedCode:
    """Generated equations for certain values of the Boolean parameters, printed as Python functions instead of C."""

    def __init__(self, trace: Trace, switches: Mapping[str, bool]) -> None:
        self.switches = switches
        self._parameters = list(trace.s.parameters)
        self._effects = [e.name for e in trace.effects]
        places = trace.places({name: k for k, name in enumerate(self._parameters)})
        functions = (
            ("derivatives", "t x u p", trace.blocks, trace.derivative),
            ("outputs", "t x u p", trace.blocks, trace.outputs),
            ("shape", "t h u memory p", trace.shaping, [*trace.shaped, *trace.remembered]),
            ("remember", "t memory p", (), trace.started),
        )
        # functions of numpy, because they give NaN or infinity like C, where those of `math` raise exceptions
        names: dict[str, Any] = {"math": SimpleNamespace(**{**vars(math), **vars(np)})}
        self._functions: list[tuple[Any, list[str], int]] = []
        for name, arguments, blocks, results in functions:
            exec(function(Python(), name, arguments, blocks, results, places), names)
            self._functions.append((names[name], arguments.split(), len(results)))

    def values(self, at: EvaluationPoint, awake: set[str]) -> list[float]:
        """Return the values of all functions at a point, where the effects in `awake` are active."""
        numbers = {**vars(at), "p": [at.values[n] for n in self._parameters]}
        values: list[float] = []
        for call, arguments, size in self._functions:
            out, ordered = [math.nan] * size, (numbers[argument] for argument in arguments)
            cells = [np.float64(v) if isinstance(v, float) else [*map(np.float64, v)] for v in ordered]
            with np.errstate(all="ignore"):
                call(*cells, [n in awake for n in self._effects], out)
            values += map(float, out)
        return values


class Check:
    """Comparison of a model's Python equations with the code generated from them."""

    def __init__(self, model: Model, printer: ModelPrinter) -> None:
        self.model, self.printer = model, printer
        self.random = random.Random(0)

    def run(self) -> None:
        """Compare in every case; raise UnprintableModel with the first difference and the cure."""
        kinds, switches = self.model.catalogue, self.printer.switches
        flags = (dict(zip(switches, f, strict=True)) for f in product((False, True), repeat=len(switches)))
        variants = [GeneratedCode(*of) for of in zip(self.printer.variants, flags, strict=True)]
        for awake in dict.fromkeys([(), *((kind,) for kind in kinds), kinds]):
            for code in variants:
                if difference := self.first_difference(awake, code):
                    raise self.refusal(difference, awake, code)

    def first_difference(self, awake: tuple[Any, ...], code: GeneratedCode) -> Difference | None:
        """Return the first difference between Python and generated code with `awake` effects active, or None."""
        count, names = 0, {e.name for e in awake}
        for k in range(TRIES):
            at = self.draw_point(awake, code, k)
            try:
                python = [(quantity, hook, float(value)) for quantity, hook, value in self.evaluate(names, at)]
                generated = code.values(at, names)
            except (ArithmeticError, ValueError, TypeError):  # The model has no real value at this point.
                continue
            for (quantity, hook, value), other in zip(python, generated, strict=True):
                if math.isfinite(value) and not abs(value - other) <= PEER_TOLERANCE * max(1.0, abs(value)):
                    return quantity, hook, value, other
            count += 1
            if count == POINTS:
                break
        return None

    def evaluate(self, names: set[str], at: EvaluationPoint) -> Values:
        """Return derivatives, outputs, shaped commands, and memory of effects after a substep and at the start.

        The memory of a dormant effect is NaN. Delays are skipped, because their C code is not generated.
        """
        base = {n: v for n, v in at.values.items() if "." not in n or n.partition(".")[0] in names}
        stepper = Stepper(replace(self.model, effects=()).with_values(base))
        states = [q.name for q in self.printer.states]
        acting = [q.name for q in stepper.model.states]
        state, command = tuple(at.x[states.index(name)] for name in acting), tuple(at.u)
        rates = dict.fromkeys(states, 0.0) | dict(zip(acting, stepper.derivative(at.t, state, command), strict=True))
        values = [(f"der({name})", "equations", rate) for name, rate in rates.items()]
        outputs = zip(self.model.outputs, stepper.output(at.t, state, command), strict=True)
        values += [(q.name, "equations", value) for q, value in outputs]
        after, starts, place = Values(), Values(), 0
        awake = {e.name: e for e in stepper.model.awake}
        for effect in overrides(self.printer.trace.effects, "shape", Effect):
            if effect.delay:
                continue
            own = tuple(at.memory[place : place + len(effect.memory)])
            place += len(own)
            now = begin = (math.nan,) * len(own)
            if active := awake.get(effect.name):
                begin = active.remember(at.t, own)
                command, now = active.shape(SCALAR, at.t, at.h, command, own)
            for q, value, start in zip(effect.memory, now, begin, strict=True):
                quantity = f"{effect.name}.{q.name} in memory"
                after.append((quantity, "shape", value))
                starts.append((f"{quantity} at the start", "remember", start))
        shaped = zip(self.model.inputs, command, strict=True)
        return [*values, *((f"{q.name} after all effects", "shape", value) for q, value in shaped), *after, *starts]

    def draw_point(self, awake: tuple[Any, ...], code: GeneratedCode, k: int) -> EvaluationPoint:
        """Return the random point of draw k.

        The first points have the model's parameter values. From draw POINTS on, points approach the start values.
        """
        size = 1.0 if k < POINTS else 10.0 ** -(k - POINTS + 1)
        uniform = self.random.uniform

        def near(value: float) -> float:
            return value + size * uniform(-1, 1) * max(1.0, abs(value))

        def scaled(p: Parameter, value: Any) -> Any:
            if isinstance(value, bool) or k % POINTS == 0:
                return value
            return min(p.bounds[1], max(p.bounds[0], value * uniform(0.8, 1.2)))

        values = {p.name: scaled(p, getattr(self.model, p.name)) for p in self.model.parameters}
        for kind in self.model.catalogue:
            for p in parameters_of(kind):
                value = p.default  # the neutral value, if the parameter has one
                if p.neutral is not None and kind in awake:
                    gap = min(1.0, p.bounds[1] - p.neutral) / 2.0
                    value = p.typical or p.neutral + (gap if gap > 0.0 else -1.0)
                values[f"{kind.name}.{p.name}"] = value if value == p.neutral else scaled(p, value)
            for name, smaller in kind.at_least.items() if kind in awake else ():
                key = f"{kind.name}.{name}"
                values[key] = max(values[key], values[f"{kind.name}.{smaller}"])
        starts = dict(zip((q.name for q in self.model.states), self.model.start(), strict=True))
        memory = [near(q.start) for _, q in self.printer.remembering]
        state = [near(float(starts.get(q.name, q.start))) for q in self.printer.states]
        command = [near(float(v)) for v in self.model.start_command()]
        substep = self.model.substep * uniform(0.1, 1.0)
        return EvaluationPoint(uniform(0.0, 10.0), substep, state, command, memory, {**values, **code.switches})

    def refusal(self, difference: Difference, awake: tuple[Any, ...], code: GeneratedCode) -> UnprintableModel:
        """Return the error for a difference between Python and C, with the class at fault and the cure."""
        quantity, hook, python, generated = difference
        kinds, model = self.model.catalogue, type(self.model)
        words = [f"{', '.join(e.name for e in awake)} active" if awake else "no effect active"]
        words += [f"{name} {str(on).lower()}" for name, on in code.switches.items()]
        text = f"{quantity} is {python:.9g} in Python and {generated:.9g} in C, with {', '.join(words)}"
        if len(awake) == 1:
            return UnprintableModel(text, awake[0], "" if hook == "equations" else hook, DECIDED)
        if awake or not kinds or self.first_difference(kinds, code):
            return UnprintableModel(text, model, "equations", DECIDED)
        # An effect is at fault if the difference occurs with only this effect dormant.
        others = ((kind, tuple(k for k in kinds if k is not kind)) for kind in kinds)
        culprits = [kind for kind, rest in others if self.first_difference(rest, code)]
        owner, hook = (culprits[0], "") if len(culprits) == 1 else (model, "equations")
        return UnprintableModel(text, owner, hook, NOT_NEUTRAL)
