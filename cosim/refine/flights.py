"""Experiments that a rig can fly: signals on a few axes, and what the model does under them.

The hovercraft flies in closed loop: a tilt of 1° askew, left alone, spins it up within seconds. What is to be added to
the tilts is put on the references, divided by the gain that leads from them to the tilts: in the very sample the
controller commands it. It leaves the duties alone, so they are played. Any other model is played open loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controller.gains import Settings
from controller.loop import Loop
from cosim.blocks.sources import profile_function
from cosim.refine.kernel import Array
from cosim.refine.log import Log
from cosim.scenario import Change, Profile
from plant.integrate import Stepper
from plant.model import Model, Values

Signals = Mapping[str, Array]
FASTEST = 0.1  # of the sample rate
SLOWEST = 2.0  # periods in a flight
REFERENCE_BAND = (0.05, 0.5)  # [Hz]
TURN = math.pi  # [rad] of heading asked of the loop, either way
TRAVEL = 0.9  # of the allowed excursion that is asked of the loop
DITHER = 0.5  # of the tilt limit; the loop needs the rest
DUTY_DIFFERENCE = 0.3  # of the duty limit between right and left, the rest on both


@dataclass(frozen=True)
class Axis:
    """Something an experiment may move: up to ±amplitude, between two frequencies [Hz]."""

    name: str
    amplitude: float
    slowest: float
    fastest: float


@dataclass(frozen=True)
class Flight:
    """A flight without noise, all by name: signals of the axes, the model's inputs, what the loop was told, outputs."""

    time: Array
    signals: Signals
    inputs: dict[str, Array]
    references: dict[str, Array]
    outputs: dict[str, Array]

    def log(self, model: Model, measured: tuple[str, ...]) -> Log:
        """The log it would leave."""
        units = {q.name: q.unit for q in (*model.inputs, *model.outputs)}
        outputs = {name: self.outputs[name] for name in measured}
        return Log(Path("flight.csv"), self.time, self.inputs, outputs, units, model.rate, units, {})

    def excursion(self, name: str) -> tuple[float, float]:
        """Least and largest value of an output."""
        return float(np.min(self.outputs[name])), float(np.max(self.outputs[name]))

    def beyond(self, limits: Mapping[str, float]) -> float:
        """The largest excursion from the start, in parts of what is allowed; infinite where the flight diverged."""
        if not all(np.isfinite(values).all() for values in self.outputs.values()):
            return math.inf
        seen = (np.abs(self.outputs[n] - self.outputs[n][0]).max() / v for n, v in limits.items() if n in self.outputs)
        return float(max(seen, default=0.0))


class OpenLoop:
    """Any model: each input is an axis about its start value."""

    usual = "a step of each input in turn"  # what is flown without thinking, to compare an experiment with

    def __init__(self, model: Model, limits: Mapping[str, float], duration: float) -> None:
        fastest = FASTEST / model.rate
        slowest = min(SLOWEST / duration, fastest)
        self.axes = tuple(Axis(q.name, limits[q.name], slowest, fastest) for q in model.inputs)

    def fly(self, model: Model, signals: Signals) -> Flight:
        """Inputs played to the model."""
        rest = model.start_command()
        u = np.column_stack([start + signals[q.name] for q, start in zip(model.inputs, rest, strict=True)])
        rows = [tuple(row) for row in u.tolist()]
        return _flight(model, len(rows), lambda k, y: rows[k], signals, {})

    def usual_signals(self, time: Array) -> Signals:
        """One input after the other at half of what it may, forth and back."""
        place = time / time[-1] * len(self.axes)
        return {
            a.name: 0.5
            * a.amplitude
            * (((place >= k) & (place < k + 0.5)) * 1.0 - ((place >= k + 0.5) & (place < k + 1)))
            for k, a in enumerate(self.axes)
        }


class ClosedLoop:
    """The hovercraft under its own controller: references, dither on both tilts and between them, duties."""

    usual = "the manoeuvre"
    sensors = ("psi", "psi_dot", "ax")
    commanded = ("tilt_right", "tilt_left")

    def __init__(self, model: Model, limits: Mapping[str, float], duration: float) -> None:
        self.settings = Settings(tilt_max=min(limits["tilt_right"], limits["tilt_left"]), sample_time=model.rate)
        room, duty = min(limits["x_world"], limits["y_world"]), min(limits["duty_right"], limits["duty_left"])
        band = min(SLOWEST / duration, FASTEST / model.rate), FASTEST / model.rate
        dither = DITHER * self.settings.tilt_max
        self.axes = (
            Axis("x_ref", TRAVEL * room, *REFERENCE_BAND),
            Axis("psi_ref", TURN, *REFERENCE_BAND),
            Axis("tilt_common", dither, *band),
            Axis("tilt_difference", dither, *band),
            Axis("duty_common", (1.0 - DUTY_DIFFERENCE) * duty, *band),
            Axis("duty_difference", DUTY_DIFFERENCE * duty, *band),
        )

    def fly(self, model: Model, signals: Signals) -> Flight:
        """The loop as a co-simulation runs it, Gauss-Seidel, without noise."""
        x_ref = signals["x_ref"] + signals["tilt_common"] / self.settings.k_1_1
        psi_ref = signals["psi_ref"] + signals["tilt_difference"] / self.settings.k_1_3
        rest = self.settings.duty_nominal
        right = rest + signals["duty_common"] + signals["duty_difference"]
        left = rest + signals["duty_common"] - signals["duty_difference"]
        loop = Loop(self.settings, [0.0] * 5, float(x_ref[0]), float(psi_ref[0]))
        names = [q.name for q in model.outputs]
        sensors = [names.index(name) for name in self.sensors]

        def command(k: int, y: Values) -> Values:
            if k:
                loop.step([y[j] for j in sensors], float(x_ref[k]), float(psi_ref[k]))
            return float(right[k]), float(left[k]), *loop.command

        return _flight(model, len(x_ref), command, signals, {"x_ref": x_ref, "psi_ref": psi_ref})

    def usual_signals(self, time: Array) -> Signals:
        """The five commands of scenarios/manoeuvre.yaml, as far as the time goes."""
        x = Profile(changes=[Change(at=5, to=1.5), Change(at=17, to=3.0)])
        right, about = Change(at=1, to=-math.pi / 2), Change(at=10, to=math.pi / 2, rate=math.pi / 4)
        psi = Profile(changes=[right, about, Change(at=22, to=0.0)])
        signals = {a.name: np.zeros(len(time)) for a in self.axes}
        for name, profile in (("x_ref", x), ("psi_ref", psi)):
            signals[name] = np.array([profile_function(profile)(t) for t in time.tolist()])
        return signals


Rig = OpenLoop | ClosedLoop


def _flight(
    model: Model, count: int, command: Callable[[int, Values], Values], signals: Signals, references: dict[str, Array]
) -> Flight:
    """Step a model; `command` gives the inputs that act from row k, from the outputs there."""
    stepper = Stepper(model)
    moment = stepper.start()
    u: Values = model.start_command()
    inputs, outputs = np.full((count, len(model.inputs)), np.nan), np.full((count, len(model.outputs)), np.nan)
    try:
        for k in range(count):
            u = command(k, stepper.output(moment.t, moment.state, u))
            inputs[k], outputs[k] = u, stepper.output(moment.t, moment.state, u)
            moment = stepper.step(moment, u, model.rate)
    except (ArithmeticError, ValueError):  # math.sin of infinity: the rows from here on stay NaN
        pass
    return Flight(
        model.rate * np.arange(count, dtype=np.float64),
        signals,
        {q.name: inputs[:, j] for j, q in enumerate(model.inputs)},
        references,
        {q.name: outputs[:, j] for j, q in enumerate(model.outputs)},
    )
