"""Choice of an integrator and substep that are stable and accurate for the model's modes.

Filter and FMU integrate by RK4 in equal substeps. In a substep of h, a mode of eigenvalue λ is multiplied by R(λh),
R(z) = 1 + z + z²/2 + z³/6 + z⁴/24, instead of exp(λh). If |R| > 1, the mode grows although the model decays.

A `substep` stated by the class is kept unless it is unstable; the default is kept if it is accurate. Otherwise the
longest accurate fraction 1/n of `rate` is chosen. A model that needs more than MOST_SUBSTEPS is stiff if all modes too
fast for RK4 decay within a row. The implicit method then uses substeps accurate for the remaining modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import InputError
from cosim.core.messages import Note
from cosim.core.registry import is_model
from cosim.core.text import amount
from cosim.files.artefact import Checking
from cosim.fmi.building.declared import ModelText
from cosim.fmi.building.file import LoadedModel, load_model, only_model
from cosim.fmi.building.own_run import RunLog, command_rows, moments
from cosim.model.integrate import Stepper, substeps
from cosim.model.model import AUTO, RK4, STIFF, Model, Values
from cosim.model.symbolic.linearize import Linearizer

MAX_DEFAULT = 1.0  # largest |λ|·h of the default substep: R is within 2 % of exp(λh)
MAX_CHOSEN = 0.5  # |λ|·h of a chosen substep: R is within 0.05 % of exp(λh); fits may change λ
MOST_SUBSTEPS = 100  # RK4 substeps per `rate`; a model that needs more is stiff
LEAST_STIFF = 8  # implicit substeps per row
MAX_RESOLVED = 10.0  # |λ| times a row up to which the implicit method resolves a mode; faster modes decay within a row
DECAYED_EIGENVALUE = 5.0  # -Re(λ) times a row after which a mode has decayed to 0.7 %
GROWTH_TOLERANCE = 1e-9  # tolerance of |R| above 1
EIGENVALUE_POINTS = 500  # of a log for computing eigenvalues
MAX_LOG_ROWS = 20_000  # of a log for running the model


@dataclass(frozen=True)
class StateMode:
    """An eigenvalue of the Jacobian [1/s], the state with the largest participation, and where it was computed."""

    eigenvalue: complex
    state: str
    place: str

    @property
    def speed(self) -> float:
        """Return the magnitude of the eigenvalue [1/s]."""
        return abs(self.eigenvalue)

    def __str__(self) -> str:
        return f"{self.state} has a fast mode (time constant {_ms(1.0 / self.speed)}, {self.place})"


def with_substep(loaded: LoadedModel, logs: Sequence[RunLog] = ()) -> tuple[LoadedModel, list[str]]:
    """Return the model with an integrator and a substep that suit its fastest mode, and notes.

    Modes are computed at the start and along a simulation over each log. Registered models keep their settings.

    Raises:
        InputError: The stated substep is unstable, or a mode is too fast for RK4 and does not decay within a row.
    """
    model, kinds = loaded.model, type(loaded.model).__mro__
    # True if class or model file states a substep
    is_stated = model.chosen_substep is not None or any("substep" in vars(k) for k in kinds[: kinds.index(Model)])
    if not model.base_states or is_model(loaded.source) or (model.integrator == STIFF and is_stated):
        return loaded, []
    text = ModelText(Path(loaded.source.rpartition(":")[0]))
    fastest = _Fastest(model, min([model.rate, *(log.step for log in logs)]))
    rows = [(fastest.at_start(), model.rate), *((fastest.along(log), log.step) for log in logs)]
    modes = [(mode, step / substeps(step, model.substep)) for mode, step in rows]
    if is_stated:
        for mode, h in sorted(modes, key=lambda pair: -pair[0].speed * pair[1]):
            z = mode.eigenvalue * h
            growth = abs(1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0))))
            if z.real < 0.0 and growth > 1.0 + GROWTH_TOLERANCE:
                reason = f"substep is {_ms(model.substep)}, unstable for this model: {mode}"
                cure = f"use at most {_ms(MAX_DEFAULT / mode.speed)}, or omit substep, so that cosim chooses it"
                message = f"{reason}, which RK4 amplifies in steps of {_ms(h)}; {cure}"
                raise InputError([text.fault(type(model), "substep", message)])
        return loaded, []
    if model.integrator != STIFF and all(mode.speed * h <= MAX_DEFAULT for mode, h in modes):
        return loaded, []
    mode = max((mode for mode, _ in modes), key=lambda m: m.speed)
    count = math.ceil(model.rate * mode.speed / MAX_CHOSEN)
    too_fast, integrator = model.integrator == AUTO and count > MOST_SUBSTEPS, model.chosen_integrator
    if model.integrator == STIFF or (too_fast and fastest.die_within_a_row()):
        substep, integrator = fastest.stiff_substep(), STIFF
        note = Note(f"integrated by the implicit method instead of RK4, in substeps of {_ms(substep)}: {mode}")
    elif count > MOST_SUBSTEPS:
        reason = f"{type(model).__name__} is stiff or unstable: {mode}, for which RK4 needs more than {MOST_SUBSTEPS}"
        cure = (
            f"check its parameters, start values and the units of the log; or set integrator = 'stiff', replace the "
            f"equation of {mode.state} by an algebraic one, or set a substep of at most {_ms(MAX_DEFAULT / mode.speed)}"
        )
        raise InputError([text.fault(type(model), "", f"{reason} substeps per step of the rate; {cure}")])
    else:
        substep = model.rate / count
        note = Note(f"integrated in substeps of {_ms(substep)} instead of the default {_ms(Model.substep)}: {mode}")
    return replace(loaded, model=model.with_substep(substep, integrator)), [note]


class _Fastest:
    """Fastest mode of a model at its start and along logs."""

    def __init__(self, model: Model, row: float) -> None:
        self.model, self.row = model, row
        self.eigenvalues: list[NDArray[np.complex128]] = []
        try:
            self.linearized: Linearizer | None = Linearizer(model)
        except (NotImplementedError, ValueError):  # no derivative, e.g. of `%`: the default substep stays
            self.linearized = None

    def at_start(self) -> StateMode:
        """Return the fastest mode at the start values."""
        return self._at(self.model.start(), self.model.start_command(), 0.0, "at the start")

    def along(self, log: RunLog) -> StateMode:
        """Return the fastest mode of the model at points of a log."""
        every = max(1, min(len(log.time), MAX_LOG_ROWS) // EIGENVALUE_POINTS)
        commands, model = command_rows(self.model, log), self.model
        stepper, fastest = Stepper(model), self.at_start()
        for k, _, moment in islice(moments(stepper, log), 0, MAX_LOG_ROWS):
            if k % every:
                continue
            mode = self._at(moment.state, commands[k], moment.t, f"at t = {moment.t:.6g} s of {log.path.name}")
            if not mode.speed <= fastest.speed:
                fastest = mode
            if model.rate * fastest.speed <= MOST_SUBSTEPS * MAX_CHOSEN:
                accurate = MAX_CHOSEN / fastest.speed if fastest.speed > 0.0 else math.inf
                stepper.model = model.with_substep(min(model.substep, accurate), RK4)
            elif model.integrator != RK4 and self.die_within_a_row():
                stepper.model = model.with_substep(self.stiff_substep(), STIFF)
            else:
                break  # The run would take too many substeps.
        return fastest

    def die_within_a_row(self) -> bool:
        """Return True if every mode that is too fast for RK4 decays within a row."""
        values = np.concatenate(self.eigenvalues)
        fast = values[self.model.rate * np.abs(values) > MOST_SUBSTEPS * MAX_CHOSEN]
        return bool(np.all(-self.row * fast.real >= DECAYED_EIGENVALUE))

    def stiff_substep(self) -> float:
        """Return the longest accurate implicit substep [s]."""
        z = self.row * np.abs(np.concatenate([np.zeros(1), *self.eigenvalues]))
        return self.row / max(LEAST_STIFF, math.ceil(float(z[z <= MAX_RESOLVED].max()) / MAX_CHOSEN))

    def _at(self, state: Values, command: Values, t: float, place: str) -> StateMode:
        """Return the fastest mode at a point, with the state of the largest participation.

        The participation is the product of left and right eigenvector, independent of units.
        """
        from scipy.linalg import eig

        A = np.zeros((0, 0))
        if self.linearized:
            with suppress(ArithmeticError, ValueError):  # no derivative at this point
                A = self.linearized(state, command, t).A
        if not A.size or not np.isfinite(A).all():
            return StateMode(0.0, "", place)
        values, rows, columns = eig(A, left=True, right=True)
        self.eigenvalues.append(values)
        k = int(np.argmax(np.abs(values)))
        of_state = int(np.argmax(np.abs(rows[:, k] * columns[:, k])))
        return StateMode(complex(values[k]), self.model.states[of_state].name, place)


def _ms(seconds: float) -> str:
    """Return a duration as text in s or ms."""
    return amount(1000.0 * seconds, "ms") if seconds < 0.5 else amount(seconds, "s")


def check_model(path: Path, checking: Checking) -> list[str]:
    """Check a model.yaml or a model class; return notes, raise InputError with all faults.

    The class is `FILE.py:Class`, or the only class in FILE.py.
    """
    text = str(path)
    if path.suffix == ".py":
        text += f":{type(only_model(path)).__name__}"
    return substep_notes(load_model(text, Path()))


def substep_notes(loaded: LoadedModel, logs: Sequence[Any] = ()) -> list[str]:
    """Return notes on an automatically chosen substep; raise InputError if no substep is suitable."""
    return [f"note: {note}" for note in with_substep(loaded, logs)[1]]
