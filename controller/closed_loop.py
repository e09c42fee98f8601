"""Rig for experiments on the craft in closed loop with its controller.

Without control, a tilt error of 1° spins the hovercraft up within seconds. Tilt signals (dither) are therefore added to
the references, divided by the gain from reference to tilt, so that the controller commands the dither in the same
sample. Duties are not controlled; their signals are applied directly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from controller.loop import Loop
from controller.settings import Settings
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.experiment.rigs import (
    MAX_FREQUENCY_SHARE,
    MIN_PERIODS,
    OpenLoop,
    Ranges,
    RigAxis,
    Signals,
    Trial,
    clip,
    trial_of,
)
from cosim.files.csv_source import write_columns
from cosim.fmi.fmu_build import build
from cosim.model import Model, Values
from fmus.recipes import controller_recipe

REFERENCE_BAND = (0.05, 0.5)  # [Hz]
HEADING_REFERENCE_RAD = math.pi  # [rad] heading reference in both directions
TRAVEL = 0.9  # share of the allowed excursion used for references
DITHER = 0.5  # share of the tilt limit; the loop needs the rest
DUTY_DIFFERENCE = 0.3  # share of the duty limit for the difference; the rest is common


def manoeuvre(t: float) -> tuple[float, float]:
    """Return the references x [m] and ψ [rad] of App. G at time t [s], as in scenarios/manoeuvre.yaml.

    x has two steps, ψ two steps and a ramp of 45 °/s.
    """
    x = 1.5 * ((t >= 5.0) + (t >= 17.0))
    psi = -0.5 * math.pi * (t >= 1.0) + min(math.pi, max(0.0, 0.25 * math.pi * (t - 10.0)))
    return x, psi * (t < 22.0)


class ClosedLoop(OpenLoop):
    """The hovercraft with its controller; an experiment varies references, common and differential tilt, and duties."""

    usual = "the manoeuvre"
    files: tuple[str, ...] = ("references.csv", "controller.fmu")
    sensors = ("psi", "psi_dot", "ax")
    commanded = ("tilt_right", "tilt_left")

    def __init__(self, model: Model, limits: Mapping[str, float], ranges: Ranges, duration: float) -> None:
        self.ranges = ranges
        tilts = []  # tilt limit of each propeller, equal in both directions
        for name in self.commanded:
            low, high = ranges.get(name, (-math.inf, math.inf))
            if not low < 0.0 < high:
                raise InputError.at(
                    Path("--range"),
                    f"{name}={low:g}..{high:g}: the controller tilts in both directions; give a range around 0",
                )
            tilts.append(min(limits[name], -low, high))
        self.settings = Settings(tilt_max=min(tilts), sample_time=model.rate)
        room, duty = min(limits["x_world"], limits["y_world"]), min(limits["duty_right"], limits["duty_left"])
        band = min(MIN_PERIODS / duration, MAX_FREQUENCY_SHARE / model.rate), MAX_FREQUENCY_SHARE / model.rate
        dither = DITHER * self.settings.tilt_max
        self.axes = (
            RigAxis("x_ref", TRAVEL * room, *REFERENCE_BAND),
            RigAxis("psi_ref", HEADING_REFERENCE_RAD, *REFERENCE_BAND),
            RigAxis("tilt_common", dither, *band),
            RigAxis("tilt_difference", dither, *band),
            RigAxis("duty_common", (1.0 - DUTY_DIFFERENCE) * duty, *band),
            RigAxis("duty_difference", DUTY_DIFFERENCE * duty, *band),
        )

    def play(self, model: Model, signals: Signals) -> Trial:
        """Simulate the noise-free loop in Gauss-Seidel order, as a co-simulation."""
        x_ref = signals["x_ref"] + signals["tilt_common"] / self.settings.k_1_1
        psi_ref = signals["psi_ref"] + signals["tilt_difference"] / self.settings.k_1_3
        rest = self.settings.duty_nominal
        right = clip(rest + signals["duty_common"] + signals["duty_difference"], "duty_right", self.ranges)
        left = clip(rest + signals["duty_common"] - signals["duty_difference"], "duty_left", self.ranges)
        loop = Loop(self.settings, [0.0] * 5, float(x_ref[0]), float(psi_ref[0]))
        names = [q.name for q in model.outputs]
        sensors = [names.index(name) for name in self.sensors]

        def command(k: int, y: Values) -> Values:
            if k:
                loop.step([y[j] for j in sensors], float(x_ref[k]), float(psi_ref[k]))
            return float(right[k]), float(left[k]), *loop.command

        return trial_of(model, len(x_ref), command, signals, {"x_ref": x_ref, "psi_ref": psi_ref})

    def usual_signals(self, time: Array) -> Signals:
        """Return the signals of an experiment without excitation: the references of `manoeuvre`, and no dither."""
        x, psi = np.array([manoeuvre(t) for t in time.tolist()]).T
        return {a.name: np.zeros(len(time)) for a in self.axes} | {"x_ref": x, "psi_ref": psi}

    def write(self, folder: Path, trial: Trial) -> None:
        """Write the files of the references (with dither) and of the controller."""
        write_columns(folder / "references.csv", trial.time, trial.references, {"x_ref": "m", "psi_ref": "rad"})
        build(controller_recipe(), folder / "controller.fmu")

    def components(self) -> Iterator[str]:
        """Yield the scenario lines of references and controller."""
        yield "  references: {block: playback, file: references.csv} # including the tilt dither"
        yield f"  controller: {{fmu: controller.fmu, start: {{tilt_max: {self.settings.tilt_max:.9g}}}}}"

    def connections(self, model: Model, trial: Trial, variance: Mapping[str, float]) -> Iterator[str]:
        """Yield the scenario lines of the connections of controller and duties."""
        for name in self.sensors:
            yield f"  - {{from: plant.{name}, to: controller.{name}, noise: {{variance: {variance[name]:g}}}}}"
        yield from (f"  - {{from: references.{name}, to: controller.{name}}}" for name in trial.references)
        yield from (f"  - {{from: controller.{name}, to: plant.{name}}}" for name in self.commanded)
        names = (q.name for q in model.inputs if q.name not in self.commanded)
        yield from (f"  - {{from: excitation.{name}, to: plant.{name}}}" for name in names)
