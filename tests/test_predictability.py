"""The horizon of predictions follows the growth of start errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.estimation.posing import build_problem, predictable_horizon
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import read_log
from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter
from tests.logs import write_log

STEP, ROWS = 0.02, 1000


@dataclass(frozen=True, kw_only=True)
class Second(Model):
    """ẍ = k·x − d·ẋ + u, measured: x."""

    base_states = (Quantity("position", "m", "x"), Quantity("speed", "m/s", "ẋ"))
    inputs = (Quantity("push", "m/s2", "u"),)
    outputs = (Quantity("position", "m", "x"),)
    sensor_variance, start_variance = {"position": 1e-8}, {"speed": 1.0}
    forced = ("speed",)
    stiffness: float = parameter(0.0, unit="1/s2", bounds=(-1e4, 1e4), doc="k")
    damping: float = parameter(0.0, unit="1/s", bounds=(0, 100), doc="d")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return state[1], self.stiffness * state[0] - self.damping * state[1] + command[0]

        return Equations(derivative, lambda t, state, command: (state[0],))


def horizon_of(folder: Path, model: Model, horizon: float) -> float:
    """Return the predictable horizon of a model on a log of oscillations that a controller keeps within a metre."""
    t = STEP * np.arange(ROWS)
    x = np.sin(1.3 * t) + 0.5 * np.sin(2.9 * t + 1.0)
    v = np.gradient(x, STEP)
    u = np.gradient(v, STEP) - model.stiffness * x + model.damping * v
    path = write_log(folder / "log.csv", {"time": t, "push": u, "position": x})
    log = read_log(path, model.inputs, model.outputs)
    return predictable_horizon(build_problem(ModelSubject.of(model), [log]), horizon)


def test_start_errors_of_an_unstable_plant_grow_tenfold_within_the_horizon(tmp_path: Path) -> None:
    # the unstable mode e^(5t) of ẍ = 25x holds half of a displaced speed over 5, so ×10 comes after some 0.6 s
    horizon = horizon_of(tmp_path, Second(stiffness=25.0), 4.0)
    assert math.log(10.0) / 5.0 - 0.1 < horizon < math.log(20.0) / 5.0 + 0.1
