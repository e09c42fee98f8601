"""A ferry that drifts sideways and turns, as a model of one's own, and logs of one that sways when it turns."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.logs import write_log
from tests.rail import STEP, lasting

MODEL = '''"""Sway and yaw of a ferry, each with a thruster and friction of its own."""

from dataclasses import dataclass

from cosim.model import Effect, Equations, Model, Quantity, overrides, parameter


class FerryEffect(Effect):
    """Accelerations that the base model lacks, of sway and yaw."""

    def more(self, m, sway, yaw):
        return 0.0, 0.0


@dataclass(frozen=True, kw_only=True)
class Coupling(FerryEffect):
    name = "coupling"
    equation = "v' + c r"
    factor: float = parameter(0.0, unit="m/s", bounds=(-5, 5), neutral=0.0, typical=0.1, doc="c")

    def more(self, m, sway, yaw):
        return self.factor * yaw, 0.0


@dataclass(frozen=True, kw_only=True)
class SwayDrag(FerryEffect):
    name = "sway_drag"
    equation = "v' - k |v| v"
    factor: float = parameter(0.0, unit="1/m", bounds=(0, 20), neutral=0.0, typical=0.3, doc="k")

    def more(self, m, sway, yaw):
        return -self.factor * m.where(sway >= 0.0, sway, -sway) * sway, 0.0


@dataclass(frozen=True, kw_only=True)
class YawDrag(FerryEffect):
    name = "yaw_drag"
    equation = "r' - k |r| r"
    factor: float = parameter(0.0, unit="1", bounds=(0, 20), neutral=0.0, typical=0.3, doc="k")

    def more(self, m, sway, yaw):
        return 0.0, -self.factor * m.where(yaw >= 0.0, yaw, -yaw) * yaw


@dataclass(frozen=True, kw_only=True)
class Wind(FerryEffect):
    name = "wind"
    equation = "v' + w"
    push: float = parameter(0.0, unit="m/s2", bounds=(-1, 1), neutral=0.0, typical=0.02, doc="w")

    def more(self, m, sway, yaw):
        return self.push, 0.0


@dataclass(frozen=True, kw_only=True)
class Ferry(Model):
    """v' = side - b v, r' = turn - d r."""

    title = "Ferry"
    base_states = (
        Quantity("y", "m", "to the side"), Quantity("sway", "m/s", "its rate"),
        Quantity("heading", "rad", "heading"), Quantity("yaw", "rad/s", "its rate"),
    )
    inputs = (Quantity("side", "m/s2", "of the side thruster"), Quantity("turn", "rad/s2", "of the stern thruster"))
    outputs = (base_states[0], base_states[2])
    catalogue = (Coupling, SwayDrag, YawDrag, Wind)
    sensor_variance = {"y": 1e-6, "heading": 1e-6}
    start_variance = {"sway": 0.04, "yaw": 0.04}
    forced = ("sway", "yaw")
    calibrated = ("sway_friction", "yaw_friction")
    substep, rate, horizon = 0.005, 0.02, 2.0
    sway_friction: float = parameter(0.5, unit="1/s", bounds=(0, 10), tolerance=0.3, doc="b")
    yaw_friction: float = parameter(0.8, unit="1/s", bounds=(0, 10), tolerance=0.3, doc="d")

    def equations(self, m):
        terms = overrides(self.awake, "more", FerryEffect)

        def derivative(t, state, command):
            y, sway, heading, yaw = state
            dv, dr = command[0] - self.sway_friction * sway, command[1] - self.yaw_friction * yaw
            for term in terms:
                more = term.more(m, sway, yaw)
                dv, dr = dv + more[0], dr + more[1]
            return sway, dv, yaw, dr

        return Equations(derivative, lambda t, state, command: (state[0], state[2]))
'''


def ferry_log(path: Path, seed: int, coupling: float, push: float, seconds: float = 20.0) -> Path:
    """Exact between the rows: all is linear. Friction of both is 15 % off the model's."""
    from scipy.linalg import expm

    rng, rows = np.random.default_rng(seed), round(seconds / STEP)
    A = np.array([[0, 1, 0, 0], [0, -0.575, 0, coupling], [0, 0, 0, 1], [0, 0, 0, -0.68]])
    B = np.array([[0, 0], [1, 0], [0, 0], [0, 1.0]])
    step = expm(STEP * np.block([[A, B], [np.zeros((2, 6))]]))
    u = np.array([np.repeat(rng.uniform(-0.4, 0.4, rows // 60 + 1), 60)[:rows] for _ in range(2)])
    pushed = u + np.array([lasting(rng, rows, push, 2.0), lasting(rng, rows, push, 2.0)])
    x, seen = np.zeros(4), np.empty((rows, 2))
    for k in range(rows):
        seen[k] = x[[0, 2]]
        x = step[:4, :4] @ x + step[:4, 4:] @ pushed[:, k]
    seen += 1e-3 * rng.standard_normal(seen.shape)
    return write_log(
        path, {"time": STEP * np.arange(rows), "side": u[0], "turn": u[1], "y": seen[:, 0], "heading": seen[:, 1]}
    )


def ferry_study(folder: Path, coupling: float, push: float) -> Path:
    """Write ferry.py, two estimation logs, a sealed log and a study; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "ferry.py").write_text(MODEL, encoding="utf-8")
    for seed, name in enumerate(("a", "b", "c")):
        ferry_log(folder / f"{name}.csv", seed, coupling, push)
    path = folder / "study.yaml"
    path.write_text("model: ferry.py:Ferry\nlogs: {estimation: [a.csv, b.csv], validation: [c.csv]}\n")
    return path
