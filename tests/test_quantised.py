"""A quantised sensor has quantisation noise, which is not mistaken for a dead band of the actuator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import read_log
from cosim.model import Effect, Equations, Model, Namespace, Number, Quantity, Values, parameter
from cosim.refinement.search.attribution import Attributor
from tests.logs import write_log
from tests.studies import weighed

STEP, ROWS = 0.02, 701
CELL = 0.02  # [rad], a hundred times the stated noise
LAG = 0.15  # [s]


@dataclass(frozen=True, kw_only=True)
class DeadBand(Effect):
    """Dead band of the command."""

    name = "dead_band"
    equation = "u − clip(u, ±w)"

    width: float = parameter(0.0, unit="rad", bounds=(0, 0.3), neutral=0.0, typical=0.02, doc="half width w")


@dataclass(frozen=True, kw_only=True)
class Servo(Model):
    """Servo of first order."""

    base_states = outputs = (Quantity("angle", "rad", "angle"),)
    inputs = (Quantity("command", "rad", "commanded angle"),)
    catalogue, forced, calibrated = (DeadBand,), ("angle",), ("lag",)
    sensor_variance = {"angle": 4e-8}  # noqa: RUF012
    rate, substep, horizon = STEP, STEP, 1.0

    lag: float = parameter(LAG, unit="s", bounds=(0.01, 2), tolerance=0.05, doc="time constant")

    def equations(self, m: Namespace) -> Equations:
        """T·dα/dt = u − α."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            u = command[0]
            for band in self.awake:
                u = u - m.minimum(m.maximum(u, -band.width), band.width)
            return ((u - state[0]) / self.lag,)

        return Equations(derivative, lambda t, state, command: state)


def searched(folder: Path, width: float) -> Attributor:
    """Return the search over logs with fast and slow commands, read in cells."""
    rng, logs, time = np.random.default_rng(3), [], STEP * np.arange(ROWS)
    for k in range(2):
        tones = zip(rng.uniform(0.2, 1.5, 6), rng.uniform(0.0, 6.0, 6), strict=True)
        command = 0.05 * np.sum([np.sin(2.0 * np.pi * f * time + phase) for f, phase in tones], axis=0)
        angle, read = 0.0, []
        for u in (command - np.clip(command, -width, width)).tolist():  # exact, as it is held over each row
            read.append(CELL * round((angle + 2e-4 * rng.standard_normal()) / CELL))
            angle = u + (angle - u) * math.exp(-STEP / LAG)
        path = write_log(folder / f"{k}.csv", {"time": time, "command": command, "angle": np.array(read)})
        logs.append(read_log(path, Servo.inputs, Servo.outputs))
    subject = ModelSubject.of(Servo())
    return Attributor(subject, build_problem(subject, logs), list(subject.candidates(("command",))))


@pytest.mark.parametrize(("width", "claim"), [(0.0, ()), (0.03, ("dead_band",))])
def test_cells_of_a_sensor_are_noise_and_no_dead_band(tmp_path: Path, width: float, claim: tuple[str, ...]) -> None:
    found = weighed(searched(tmp_path, width).run())
    assert found.claimed == set(claim)
    assert found.decision.verdict == ("effect_found" if claim else "no_effect")
    level = math.exp(0.5 * float(found.best.fit.noise.sensors[0]))
    assert CELL / math.sqrt(12.0) * 0.999 < level < CELL
