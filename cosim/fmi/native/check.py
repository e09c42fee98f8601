"""Check of generated C against a model's Python at seeded random points, before compilation.

While its equations are traced, a model may decide on numbers that are known only at run time (a look-up in a
dictionary, a test for effects). No rule detects all such lines; a comparison of two evaluations does.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np

from cosim.fmi.native.printing import ModelPrinter, UnprintableModel
from cosim.model.integrate import Stepper
from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SCALAR
from cosim.model.quantities import Parameter, parameters_of
from cosim.model.symbolic.blocks import function
from cosim.model.symbolic.languages import Python
from cosim.model.symbolic.trace import Trace

TOLERANCE = 1e-9  # of max(1, |value|)
POINTS, TRIES = 6, 18  # points per case, and draws if Python gives no number
DECIDED = (
    "the equations contain a decision that symbols cannot express (a look-up in a dictionary, int() or a branch on a "
    "number): use m.where"
)
NOT_NEUTRAL = (
    "the effect changes the equations at its neutral value, or the equations test for effects: in C a dormant "
    "effect is evaluated at its neutral value"
)
Case = tuple[tuple[Any, ...], Mapping[str, bool]]  # active effects, values of the model's Boolean parameters
Difference = tuple[str, str, float, float]  # quantity, method of the model, values by Python and by generated code


@dataclass(frozen=True)
class EvaluationPoint:
    """A point of evaluation: states x and memory (also of dormant effects), inputs u, parameters by FMI name."""

    t: float
    h: float
    x: Sequence[float]
    u: Sequence[float]
    memory: Sequence[float]
    values: Mapping[str, float | bool]


class GeneratedCode:
    """Generated equations of a model, as Python functions in place of C."""

    def __init__(self, trace: Trace) -> None:
        self.names = list(trace.s.parameters)
        self.flags = [e.name for e in trace.effects]
        places = trace.places({name: f"p[{k}]" for k, name in enumerate(self.names)})
        functions = (
            ("derivatives", "t x u p", trace.blocks, trace.derivative),
            ("outputs", "t x u p", trace.blocks, trace.outputs),
            ("shape", "t h u memory p", trace.shaping, [*trace.shaped, *trace.remembered]),
            ("remember", "t memory p", (), trace.started),
        )
        # functions of numpy give NaN or infinity, as in C, where those of `math` raise exceptions
        self._functions: dict[str, Any] = {"math": SimpleNamespace(**{**vars(math), **vars(np)})}
        self._signatures = {name: (arguments.split(), len(results)) for name, arguments, _, results in functions}
        for name, arguments, blocks, results in functions:
            exec(function(Python(), name, arguments, blocks, results, places), self._functions)

    def values(self, name: str, at: EvaluationPoint, awake: set[str]) -> list[float]:
        """Return the values of the function `name` at a point, with the effects in `awake` active."""
        arguments, size = self._signatures[name]
        numbers = {**vars(at), "p": [at.values[n] for n in self.names]}
        ordered = (numbers[argument] for argument in arguments)
        cells = (np.float64(v) if isinstance(v, float) else [*map(np.float64, v)] for v in ordered)
        out = [math.nan] * size
        with np.errstate(all="ignore"):
            self._functions[name](*cells, [n in awake for n in self.flags], out)
        return [float(v) for v in out]


class Check:
    """Comparison of a model's Python equations with its generated code."""

    def __init__(self, model: Model, printer: ModelPrinter) -> None:
        self.model, self.printer = model, printer
        self.random = random.Random(0)

    def run(self) -> None:
        """Compare in every case; raise UnprintableModel with the first difference and its remedy."""
        kinds, switches = self.model.catalogue, self.printer.switches
        variants = [GeneratedCode(trace) for trace in self.printer.variants]
        flags = list(product((False, True), repeat=len(switches)))
        for awake in dict.fromkeys([(), *((kind,) for kind in kinds), kinds]):
            for code, position in zip(variants, flags, strict=True):
                case = (awake, dict(zip(switches, position, strict=True)))
                if difference := self.first_difference(case, code):
                    raise self.refusal(difference, case, code)

    def first_difference(self, case: Case, code: GeneratedCode) -> Difference | None:
        """Return the first difference between Python and generated code in a case; None without one."""
        count = 0
        for k in range(TRIES):
            at = self.draw_point(case, k)
            try:
                pairs = [(quantity, hook, float(a), b) for quantity, hook, a, b in self.compare(case, at, code)]
            except (ArithmeticError, ValueError, TypeError):  # The model has no real value at this point.
                continue
            for quantity, hook, python, other in pairs:
                if math.isfinite(python) and not abs(python - other) <= TOLERANCE * max(1.0, abs(python)):
                    return quantity, hook, python, other
            count += 1
            if count == POINTS:
                break
        return None

    def compare(self, case: Case, at: EvaluationPoint, code: GeneratedCode) -> Iterator[Difference]:
        """Yield each compared quantity: derivatives, outputs, shaped commands, memory of effects (also initial).

        A delay is skipped because it has hand-written C code.
        """
        names = {e.name for e in case[0]}
        base = {n: v for n, v in at.values.items() if "." not in n or n.partition(".")[0] in names}
        stepper = Stepper(replace(self.model, effects=()).with_values(base))
        states = [q.name for q in self.printer.states]
        acting = [q.name for q in stepper.model.states]
        state = tuple(at.x[states.index(name)] for name in acting)
        command = tuple(at.u)
        rates = dict.fromkeys(states, 0.0) | dict(zip(acting, stepper.derivative(at.t, state, command), strict=True))
        for (name, rate), other in zip(rates.items(), code.values("derivatives", at, names), strict=True):
            yield f"der({name})", "equations", rate, other
        outputs = stepper.output(at.t, state, command)
        for q, value, other in zip(self.model.outputs, outputs, code.values("outputs", at, names), strict=True):
            yield q.name, "equations", value, other
        place = 0
        shaped, starts = code.values("shape", at, names), code.values("remember", at, names)
        awake = {e.name: e for e in stepper.model.awake}
        for effect in overrides(self.printer.trace.effects, "shape", Effect):
            if effect.delay:
                continue
            own = tuple(at.memory[place : place + len(effect.memory)])
            if effect.name in awake:
                start = awake[effect.name].remember(at.t, own)
                command, after = awake[effect.name].shape(SCALAR, at.t, at.h, command, own)
                for j, q in enumerate(effect.memory):
                    quantity = f"{effect.name}.{q.name}, remembered"
                    yield quantity, "shape", after[j], shaped[len(command) + place + j]
                    yield f"{quantity} at the start", "remember", start[j], starts[place + j]
            place += len(effect.memory)
        for q, value, other in zip(self.model.inputs, command, shaped, strict=False):
            yield f"{q.name}, as it acts", "shape", value, other

    def draw_point(self, case: Case, k: int) -> EvaluationPoint:
        """Return the random point of test k.

        Parameters of the first points are unchanged. From test POINTS on, points approach the start values.
        """
        size = 1.0 if k < POINTS else 10.0 ** -(k - POINTS + 1)
        uniform = self.random.uniform

        def around(value: float) -> float:
            return value + size * uniform(-1, 1) * max(1.0, abs(value))

        values: dict[str, Any] = {}
        for p in self.model.parameters:  # unchanged, within 10 %, or for an integer, any in its bounds
            low, high = p.bounds
            value = values[p.name] = getattr(self.model, p.name)
            if isinstance(value, bool) or k % POINTS == 0:
                continue
            is_bounded = math.isfinite(low) and math.isfinite(high)
            if k in (POINTS - 2, POINTS - 1) and is_bounded and math.ceil(low) <= math.floor(high):
                highest = min(math.floor(high), math.ceil(low) + 3)
                values[p.name] = float(self.random.randint(math.ceil(low), highest))
            else:
                values[p.name] = min(high, max(low, value * uniform(0.9, 1.1)))
        for kind in self.model.catalogue:
            awake = kind in case[0]
            values |= {f"{kind.name}.{p.name}": self.draw_effect_value(p, awake, k) for p in parameters_of(kind)}
            for name, smaller in kind.at_least.items() if awake else ():
                key = f"{kind.name}.{name}"
                values[key] = max(values[key], values[f"{kind.name}.{smaller}"])
        values |= case[1]
        starts = dict(zip((q.name for q in self.model.states), self.model.start(), strict=True))
        memory = [around(q.start) for _, q in self.printer.remembering]
        state = [around(float(starts.get(q.name, q.start))) for q in self.printer.states]
        command = [around(float(v)) for v in self.model.start_command()]
        substep = self.model.substep * uniform(0.1, 1.0)
        return EvaluationPoint(uniform(0.0, 10.0), substep, state, command, memory, values)

    def draw_effect_value(self, p: Parameter, awake: bool, k: int) -> Any:
        """Return a random parameter value of an effect: neutral if dormant, else near its default or typical size."""
        if isinstance(p.default, bool):
            return p.default
        if p.neutral is not None and not awake:
            return p.neutral
        low, high = p.bounds
        around = p.default if p.neutral is None else p.typical
        if around is None:  # a value different from the neutral value
            neutral = p.neutral or 0.0
            highest = high if math.isfinite(high) else neutral + 1.0
            around = neutral + 0.5 * (highest - neutral) if highest > neutral else neutral - 1.0
        return min(high, max(low, around * (1.0 if k == 0 else self.random.uniform(0.7, 1.3))))

    def refusal(self, difference: Difference, case: Case, code: GeneratedCode) -> UnprintableModel:
        """Return the error for a difference between Python and C, with the class at fault and a remedy."""
        quantity, hook, python, generated = difference
        (awake, switches), kinds = case, self.model.catalogue
        words = [f"{', '.join(e.name for e in awake)} awake" if awake else "every effect dormant"]
        words += [f"{name} {str(on).lower()}" for name, on in switches.items()]
        text = f"{quantity} is {python:.9g} in Python and {generated:.9g} as printed, with {', '.join(words)}"
        if len(awake) == 1:
            return UnprintableModel(text, awake[0], "" if hook == "equations" else hook, DECIDED)
        if awake or not kinds or self.first_difference((kinds, switches), code):
            return UnprintableModel(text, type(self.model), "equations", DECIDED)
        # An effect is at fault if the difference occurs with only this effect dormant.
        others = ((kind, tuple(k for k in kinds if k is not kind)) for kind in kinds)
        culprits = [kind for kind, rest in others if self.first_difference((rest, switches), code)]
        if len(culprits) == 1:
            return UnprintableModel(text, culprits[0], "", NOT_NEUTRAL)
        return UnprintableModel(text, type(self.model), "equations", NOT_NEUTRAL)
