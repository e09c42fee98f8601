"""Check of generated C against a model's Python at seeded random points, before compilation.

A model may make a decision while its equations are traced that depends on numbers at run time (a dictionary look-up of
a parameter, a test for effects). No rule detects all such lines, but comparing two evaluations does.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

from cosim.fmi.native.printing import ModelPrinter, UnprintableModel
from cosim.model.integrate import Stepper
from cosim.model.model import Effect, Model, overrides
from cosim.model.namespaces import SCALAR
from cosim.model.quantities import Parameter, parameters_of
from cosim.model.symbolic.blocks import function, places_of
from cosim.model.symbolic.languages import Python
from cosim.model.symbolic.trace import Trace

TOLERANCE = 1e-9  # of max(1, |value|)
POINTS, TRIES = 6, 18  # points per case, and draws if Python gives no number
Values = dict[str, float]
DECIDED = (
    "something is decided before the numbers are known (a look-up in a dictionary, int() or a Python branch on a "
    "number): choose by m.where"
)
NOT_NEUTRAL = (
    "its lines are not neutral at its neutral value, or the equations ask which effects there are: in C a dormant "
    "effect is its lines at the neutral value"
)


@dataclass(frozen=True)
class EvaluationPoint:
    """A point of evaluation: states and memory (those of dormant effects too), inputs, and parameters by FMI name."""

    t: float
    h: float
    state: Sequence[float]
    command: Sequence[float]
    memory: Sequence[float]
    values: Mapping[str, float | bool]


class _Math:
    """Functions of `math` with NaN or infinity as result, as in C, instead of exceptions."""

    def __getattr__(self, name: str) -> Any:
        import numpy as np

        return getattr(np, name, None) or getattr(math, name)


class GeneratedCode:
    """Generated equations of a model, as Python functions in place of C."""

    def __init__(self, trace: Trace) -> None:
        self.names = list(trace.s.parameters)
        self.flags = [e.name for e in trace.effects]
        places = places_of(trace, {name: f"p[{k}]" for k, name in enumerate(self.names)})
        shaped = [*trace.shaped, *trace.remembered]
        functions = (
            ("derivatives", "t x u p", trace.blocks, trace.derivative),
            ("outputs", "t x u p", trace.blocks, trace.outputs),
            ("shape", "t h u memory p", trace.shaping, shaped),
            ("remember", "t memory p", (), trace.started),
        )
        self._functions: dict[str, Any] = {"math": _Math()}
        self._sizes = {name: len(results) for name, _, _, results in functions}
        for name, arguments, blocks, results in functions:
            exec(function(Python(), name, arguments, blocks, results, places), self._functions)

    def values(self, name: str, at: EvaluationPoint, awake: set[str]) -> list[float]:
        """Return the values of the function `name` at a point, with the effects in `awake` active."""
        import numpy as np

        arguments: dict[str, Any] = {"t": at.t, "h": at.h, "x": at.state, "u": at.command, "memory": at.memory}
        arguments["p"] = [at.values[n] for n in self.names]
        numbers = {k: np.float64(v) if isinstance(v, float) else [*map(np.float64, v)] for k, v in arguments.items()}
        order = {"shape": "t h u memory p", "remember": "t memory p"}.get(name, "t x u p")
        out = [math.nan] * self._sizes[name]
        with np.errstate(all="ignore"):
            self._functions[name](*(numbers[a] for a in order.split()), [n in awake for n in self.flags], out)
        return [float(v) for v in out]


@dataclass(frozen=True)
class SwitchCase:
    """A case of the comparison: the active effects and the values of the model's switches."""

    awake: tuple[Any, ...]
    switches: Mapping[str, bool]

    @property
    def words(self) -> str:
        """Return the case in words."""
        effects = f"{', '.join(e.name for e in self.awake)} awake" if self.awake else "every effect dormant"
        return ", ".join([effects, *(f"{name} {str(on).lower()}" for name, on in self.switches.items())])


@dataclass(frozen=True)
class CodeDifference:
    """A difference between Python and generated code for a quantity of the model."""

    case: SwitchCase
    quantity: str
    hook: str
    python: float
    generated: float


class Check:
    """Comparison of a model's Python equations with its generated code."""

    def __init__(self, model: Model, printer: ModelPrinter) -> None:
        self.model, self.printer = model, printer
        self.random = random.Random(0)

    @cached_property
    def variants(self) -> list[GeneratedCode]:
        """Return the code of each switch position, in the printer's order."""
        return [GeneratedCode(trace) for trace in self.printer.variants]

    def run(self) -> None:
        """Compare in every case; raise UnprintableModel with the first difference and its remedy."""
        kinds = self.model.catalogue
        flags = list(product((False, True), repeat=len(self.printer.switches)))
        for awake in dict.fromkeys([(), *((kind,) for kind in kinds), kinds]):
            for code, position in zip(self.variants, flags, strict=True):
                case = SwitchCase(awake, dict(zip(self.printer.switches, position, strict=True)))
                if difference := self.first_difference(case, code):
                    raise self.refusal(difference, code)

    def first_difference(self, case: SwitchCase, code: GeneratedCode) -> CodeDifference | None:
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
                    return CodeDifference(case, quantity, hook, python, other)
            count += 1
            if count == POINTS:
                break
        return None

    def compare(
        self, case: SwitchCase, at: EvaluationPoint, code: GeneratedCode
    ) -> Iterator[tuple[str, str, float, float]]:
        """Yield each compared quantity: name, method of the model, and values by Python and by generated code."""
        names = {e.name for e in case.awake}
        base = {n: v for n, v in at.values.items() if "." not in n or n.partition(".")[0] in names}
        stepper = Stepper(replace(self.model, effects=()).with_values(base))
        states = [q.name for q in self.printer.states]
        acting = [q.name for q in stepper.model.states]
        state = tuple(at.state[states.index(name)] for name in acting)
        command = tuple(at.command)
        rates = dict.fromkeys(states, 0.0)
        rates |= zip(acting, stepper.derivative(at.t, state, command), strict=True)
        for (name, rate), other in zip(rates.items(), code.values("derivatives", at, names), strict=True):
            yield f"der({name})", "equations", rate, other
        outputs = stepper.output(at.t, state, command)
        for q, value, other in zip(self.model.outputs, outputs, code.values("outputs", at, names), strict=True):
            yield q.name, "equations", value, other
        yield from self.compare_shaping(stepper.model, at, names, code)

    def compare_shaping(
        self, model: Model, at: EvaluationPoint, names: set[str], code: GeneratedCode
    ) -> Iterator[tuple[str, str, float, float]]:
        """Yield the shaped commands and the memory of effects by Python and by generated code, also at the start.

        A delay is skipped because it has hand-written C code.
        """
        command, place = tuple(at.command), 0
        shaped, starts = code.values("shape", at, names), code.values("remember", at, names)
        awake = {e.name: e for e in model.awake}
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
        for q, value, other in zip(model.inputs, command, shaped, strict=False):
            yield f"{q.name}, as it acts", "shape", value, other

    # -- points -------------------------------------------------------------------------------------

    def draw_point(self, case: SwitchCase, k: int) -> EvaluationPoint:
        """Return the random point of test k.

        Parameters of the first points are unchanged. From test POINTS on, points approach the start values.
        """
        size = 1.0 if k < POINTS else 10.0 ** -(k - POINTS + 1)
        around: Callable[[float], float] = lambda v: v + size * self.random.uniform(-1, 1) * max(1.0, abs(v))  # noqa: E731
        values = {name: self.draw_value(p, getattr(self.model, name), k) for name, p in self.parameters.items()}
        for kind in self.model.catalogue:
            awake = kind in case.awake
            values |= {f"{kind.name}.{p.name}": self.draw_effect_value(p, awake, k) for p in parameters_of(kind)}
            for name, smaller in kind.at_least.items() if awake else ():
                key = f"{kind.name}.{name}"
                values[key] = max(values[key], values[f"{kind.name}.{smaller}"])
        values |= case.switches
        memory = [around(q.start) for _, q in self.printer.remembering]
        state = [around(float(v)) for v in self.starts]
        command = [around(float(v)) for v in self.model.start_command()]
        substep = self.model.substep * self.random.uniform(0.1, 1.0)
        return EvaluationPoint(self.random.uniform(0.0, 10.0), substep, state, command, memory, values)

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """Return the model's parameters without those of effects."""
        return {p.name: p for p in self.model.parameters}

    @cached_property
    def starts(self) -> list[float]:
        """Return the start values of all states, including those of dormant effects."""
        starts = dict(zip((q.name for q in self.model.states), self.model.start(), strict=True))
        return [starts.get(q.name, q.start) for q in self.printer.states]

    def draw_value(self, p: Parameter, value: Any, k: int) -> Any:
        """Return a value of parameter `p` for test k: `value`, within 10 % of it, or an integer in its bounds."""
        low, high = p.bounds
        if isinstance(value, bool) or k % POINTS == 0:
            return value
        is_bounded = math.isfinite(low) and math.isfinite(high)
        if k in (POINTS - 2, POINTS - 1) and is_bounded and math.ceil(low) <= math.floor(high):
            return float(self.random.randint(math.ceil(low), min(math.floor(high), math.ceil(low) + 3)))
        return min(high, max(low, value * self.random.uniform(0.9, 1.1)))

    def draw_effect_value(self, p: Parameter, awake: bool, k: int) -> Any:
        """Return a random parameter value of an effect: neutral if dormant, else about its default or typical size."""
        if isinstance(p.default, bool):
            return p.default
        if p.neutral is not None and not awake:
            return p.neutral
        low, high = p.bounds
        around = p.default if p.neutral is None else p.typical if p.typical is not None else _non_neutral_value(p)
        return min(high, max(low, around * (1.0 if k == 0 else self.random.uniform(0.7, 1.3))))

    # -- messages --------------------------------------------------------------------------------

    def refusal(self, difference: CodeDifference, code: GeneratedCode) -> UnprintableModel:
        """Return the error for a difference between Python and C, with the class at fault and a remedy."""
        kinds, case = self.model.catalogue, difference.case
        values = f"{difference.python:.9g} in Python and {difference.generated:.9g} as printed"
        text = f"{difference.quantity} is {values}, with {case.words}"
        owner: type = type(self.model)
        hook, cure = "equations", DECIDED
        if len(case.awake) == 1:
            (owner,), hook = case.awake, difference.hook if difference.hook != "equations" else ""
        elif not case.awake and kinds and not self.first_difference(SwitchCase(kinds, case.switches), code):
            cure = NOT_NEUTRAL
            culprits = [kind for kind in kinds if self.differs_without(kind, case, code)]
            if len(culprits) == 1:
                (owner,), hook = culprits, ""
        return UnprintableModel(text, owner, hook, cure)

    def differs_without(self, kind: type[Any], case: SwitchCase, code: GeneratedCode) -> bool:
        """Return whether a difference remains with this effect dormant."""
        others = tuple(k for k in self.model.catalogue if k is not kind)
        return self.first_difference(SwitchCase(others, case.switches), code) is not None


def _non_neutral_value(p: Parameter) -> float:
    """Return a value different from the neutral value."""
    neutral = p.neutral or 0.0
    high = p.bounds[1] if math.isfinite(p.bounds[1]) else neutral + 1.0
    return neutral + 0.5 * (high - neutral) if high > neutral else neutral - 1.0
