"""Choice of integrator and substep: stable and accurate for the model's modes.

Kernel and FMU integrate by RK4 in equal substeps. In a substep of h, a mode of eigenvalue λ changes by R(λh),
R(z) = 1 + z + z²/2 + z³/6 + z⁴/24, instead of exp(λh). If |R| > 1, the mode grows although the model decays.

A class keeps its stated `substep` unless unstable, and the default if accurate. Otherwise the longest accurate fraction
1/n of `rate` is chosen. A model with a need for more than MOST_SUBSTEPS is stiff if all modes too fast for RK4 decay
within a row. The implicit method then takes substeps accurate for the remaining modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.linear_algebra import eigenvalues
from cosim.base.messages import Note
from cosim.base.registry import is_model
from cosim.base.text import amount, plain
from cosim.loading.file import LoadedModel
from cosim.loading.own_run import RunLog, command_rows, moments
from cosim.loading.source import ModelText
from cosim.model.integrate import Stepper, substeps
from cosim.model.model import AUTO, RK4, STIFF, Model, Values
from cosim.model.symbolic.linearize import Linearizer

MAX_DEFAULT = 1.0  # |λ|·h for keeping the default substep: R is within 2 % of exp(λh)
MAX_CHOSEN = 0.5  # |λ|·h of a chosen substep: R is within 0.05 % of exp(λh), and fits may move λ
MOST_SUBSTEPS = 100  # RK4 substeps per `rate`; a model with more is stiff
LEAST_STIFF = 8  # implicit substeps per row
FOLLOWED = 10.0  # |λ| times a row up to which the implicit method resolves a mode; faster modes decay within a row
DEAD = 5.0  # -Re(λ) times a row after which a mode has decayed to 0.7 %
GROWTH = 1e-9  # tolerance of |R| above 1
POINTS = 500  # of a log for computing eigenvalues
MAX_ROWS = 20_000  # of a log for running the model


@dataclass(frozen=True)
class StateMode:
    """An eigenvalue of the Jacobian [1/s], the state with the largest participation, and its place."""

    eigenvalue: complex
    state: str
    place: str

    @property
    def speed(self) -> float:
        """Return the magnitude of the eigenvalue [1/s]."""
        return abs(self.eigenvalue)

    def __str__(self) -> str:
        value = self.eigenvalue
        pair = f" ± {plain(abs(value.imag))}i" if abs(value.imag) > 1e-9 * self.speed else ""
        speed = f"time constant {_ms(1.0 / self.speed)}, eigenvalue {plain(value.real)}{pair} 1/s"
        return f"{self.state} has a fast mode ({speed}, {self.place})"


def with_substep(loaded: LoadedModel, logs: Sequence[RunLog] = ()) -> tuple[LoadedModel, list[str]]:
    """Return the model with an integrator and a substep that suit its fastest mode, and notes.

    Modes are computed at the start and along the model's run on each log. Registered models keep their settings.

    Raises:
        InputError: The stated substep is unstable, or a mode too fast for RK4 does not decay within a row.
    """
    model = loaded.model
    if not model.base_states or is_model(loaded.source):
        return loaded, []
    if model.integrator == STIFF and _is_stated(model):
        return loaded, []
    fastest = _Fastest(model, min([model.rate, *(log.step for log in logs)]))
    modes = [(fastest.at_start(), _longest(model, model.rate))]
    modes += [(fastest.along(log), _longest(model, log.step)) for log in logs]
    if _is_stated(model):
        _refuse_growth(loaded, modes)
        return loaded, []
    if model.integrator != STIFF and all(mode.speed * h <= MAX_DEFAULT for mode, h in modes):
        return loaded, []
    return _choose(loaded, fastest, max((mode for mode, _ in modes), key=lambda m: m.speed))


def _refuse_growth(loaded: LoadedModel, modes: Sequence[tuple[StateMode, float]]) -> None:
    """Raise InputError if the stated substep makes a decaying mode grow; the message names the fastest such mode."""
    for mode, h in sorted(modes, key=lambda pair: -pair[0].speed * pair[1]):
        if _grows(mode.eigenvalue * h):
            lengths = {"substep": _ms(loaded.model.substep), "step": _ms(h), "longest": _ms(MAX_DEFAULT / mode.speed)}
            raise _error(
                loaded,
                "substep",
                (
                    "substep is {substep}, unstable for this model: {mode}, and RK4 in steps of {step} lets it "
                    "grow; state at most {longest}, or leave substep out: then it follows the model"
                ).format(mode=mode, **lengths),
            )


def _choose(loaded: LoadedModel, fastest: _Fastest, mode: StateMode) -> tuple[LoadedModel, list[str]]:
    """Return the model with integrator and substep for its fastest mode."""
    model = loaded.model
    count = math.ceil(model.rate * mode.speed / MAX_CHOSEN) if math.isfinite(mode.speed) else math.inf
    too_fast = model.integrator == AUTO and count > MOST_SUBSTEPS
    if model.integrator == STIFF or (too_fast and fastest.die_within_a_row()):
        substep = fastest.stiff_substep()
        note = Note(f"integrated by the implicit method, in substeps of {_ms(substep)}, not by RK4: {mode}")
        return replace(loaded, model=model.with_substep(substep, STIFF)), [note]
    if count > MOST_SUBSTEPS:
        raise _error(loaded, "", _stiff(model, mode))
    substep = model.rate / count
    note = Note(f"integrated in substeps of {_ms(substep)}, not of the default {_ms(Model.substep)}: {mode}")
    return replace(loaded, model=model.with_substep(substep, model.chosen_integrator)), [note]


def _longest(model: Model, step: float) -> float:
    """Return the substep length of a communication step [s]."""
    return step / substeps(step, model.substep)


def _is_stated(model: Model) -> bool:
    """Return whether class or model file states a substep."""
    kinds = type(model).__mro__
    return model.chosen_substep is not None or any("substep" in vars(k) for k in kinds[: kinds.index(Model)])


def _grows(z: complex) -> bool:
    """Return whether RK4 makes a decaying mode grow."""
    if not z.real < 0.0:
        return False
    return abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))) > 1.0 + GROWTH


class _Fastest:
    """Fastest mode of a model at its start and along logs."""

    def __init__(self, model: Model, row: float) -> None:
        self.model, self.row = model, row
        self.eigenvalues: list[NDArray[np.complex128]] = []
        try:
            self.linearized: Linearizer | None = Linearizer(model)
        except (NotImplementedError, ValueError):  # A function without derivative, e.g. `%`: the default substep stays.
            self.linearized = None

    def at_start(self) -> StateMode:
        """Return the fastest mode at the start values."""
        return self._at(self.model.start(), self.model.start_command(), 0.0, "at the start")

    def along(self, log: RunLog) -> StateMode:
        """Return the fastest mode of the model at points of a log."""
        rows = min(len(log.time), MAX_ROWS)
        commands, every = command_rows(self.model, log), max(1, rows // POINTS)
        stepper, fastest = Stepper(self.model), self.at_start()
        for k, _, moment in islice(moments(stepper, log), 0, rows):
            if k % every:
                continue
            place = f"at t = {moment.t:.6g} s of {log.path.name}"
            mode = self._at(moment.state, commands[k], moment.t, place)
            if not mode.speed <= fastest.speed:
                fastest = mode
            if self.model.rate * fastest.speed <= MOST_SUBSTEPS * MAX_CHOSEN:
                stepper.model = self.model.with_substep(_accurate(self.model, fastest), RK4)
            elif self.model.integrator != RK4 and self.die_within_a_row():
                stepper.model = self.model.with_substep(self.stiff_substep(), STIFF)
            else:
                break  # The run would take too many substeps.
        return fastest

    def die_within_a_row(self) -> bool:
        """Return whether modes too fast for RK4 decay within a row."""
        values = np.concatenate(self.eigenvalues)
        fast = values[self.model.rate * np.abs(values) > MOST_SUBSTEPS * MAX_CHOSEN]
        return bool(np.all(-self.row * fast.real >= DEAD))

    def stiff_substep(self) -> float:
        """Return the longest accurate implicit substep [s]."""
        z = self.row * np.abs(np.concatenate([np.zeros(1), *self.eigenvalues]))
        return self.row / max(LEAST_STIFF, math.ceil(float(z[z <= FOLLOWED].max()) / MAX_CHOSEN))

    def _at(self, state: Values, command: Values, t: float, place: str) -> StateMode:
        try:
            A = self.linearized(state, command, t).A if self.linearized else np.zeros((0, 0))
        except (ArithmeticError, ValueError):  # no derivative at this point
            A = np.zeros((0, 0))
        values = eigenvalues(A)
        if not values.size:
            return StateMode(0.0, "", place)
        self.eigenvalues.append(values)
        value = complex(values[np.argmax(np.abs(values))])
        return StateMode(value, self._state(A, value), place)

    def _state(self, A: Array, value: complex) -> str:
        """Return the state that participates most in a mode.

        Participation is left times right eigenvector, independent of units.
        """
        from scipy.linalg import eig

        values, rows, columns = eig(A, left=True, right=True)
        k = int(np.argmin(np.abs(values - value)))
        return self.model.states[int(np.argmax(np.abs(rows[:, k] * columns[:, k])))].name


def _accurate(model: Model, mode: StateMode) -> float:
    """Return a substep for finding modes, at most the model's own."""
    return min(model.substep, MAX_CHOSEN / mode.speed) if mode.speed > 0.0 else model.substep


def _stiff(model: Model, mode: StateMode) -> str:
    """Return the message on a mode too fast for the model's rate."""
    name = type(model).__name__
    if mode.eigenvalue.real > 0.0:
        return f"{name} runs away: {mode} that grows; check its parameters, start values and the units of the log"
    fields = {"model": name, "mode": mode, "most": MOST_SUBSTEPS, "rate": _ms(model.rate)}
    if model.integrator == RK4 and mode.eigenvalue.real * model.rate <= -DEAD:
        return (
            "{model} is stiff: {mode}, for which RK4 takes more than {most} substeps in a rate of {rate}; state "
            "integrator = 'stiff', or leave it out"
        ).format(**fields)
    return (
        "{model} is stiff: {mode}, for which RK4 takes more than {most} substeps in a rate of {rate}; let "
        "{state} follow the rest at once, as an algebraic equation, or state a substep of at most {longest} and "
        "take the time that it costs"
    ).format(state=mode.state, longest=_ms(MAX_DEFAULT / mode.speed), **fields)


def _ms(seconds: float) -> str:
    """Return a duration as text with a suitable unit."""
    return amount(1000.0 * seconds, "ms") if seconds < 0.5 else amount(seconds, "s")


def _error(loaded: LoadedModel, attribute: str, message: str) -> InputError:
    return InputError([ModelText(Path(loaded.source.rpartition(":")[0])).fault(type(loaded.model), attribute, message)])
