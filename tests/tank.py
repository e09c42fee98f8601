"""A tank as a model of one's own, and logs of one that leaks: by another integrator, sharing no code with the model."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from tests.logs import write_log

AREA, OUTLET, LEAK, STEP, NOISE = 0.5, 0.02, 0.012, 0.5, 1e-3
MODEL = '''"""A tank: what flows in, less what its own weight presses out."""

from dataclasses import dataclass

from plant.model import Effect, Equations, Model, Number, Values, overrides
from plant.namespaces import Namespace
from plant.quantities import Quantity, parameter
from plant.sensors import SensorError


class TankEffect(Effect):
    """A flow out of the tank that the base model lacks."""

    def loss(self, m: Namespace, level: Number) -> Number:
        """Flow [m3/s] out of the tank."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Leak(TankEffect):
    """A leak: k·h."""

    name = "leak"
    equation = "flow k·h out"

    rate: float = parameter(0.0, unit="m2/s", bounds=(0, 1), neutral=0.0, typical=0.005, doc="flow k per level")

    def loss(self, m: Namespace, level: Number) -> Number:
        return self.rate * level


@dataclass(frozen=True, kw_only=True)
class Draw(TankEffect):
    """A constant draw: f."""

    name = "draw"
    equation = "flow f out"

    flow: float = parameter(0.0, unit="m3/s", bounds=(-0.1, 0.1), neutral=0.0, typical=0.005, doc="flow f")

    def loss(self, m: Namespace, level: Number) -> Number:
        return self.flow


@dataclass(frozen=True, kw_only=True)
class GaugeOffset(SensorError):
    """The gauge reads h + b."""

    name = "gauge_offset"
    equation = "reading h + b"
    output = "level"

    value: float = parameter(0.0, unit="m", bounds=(-1, 1), neutral=0.0, typical=0.02, doc="offset b")

    def measure(self, value: Number) -> Number:
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Tank(Model):
    """A tank with an outlet."""

    title = "Tank"
    base_states = (Quantity("level", "m", "level of the water", 1.0),)
    inputs = (Quantity("inflow", "m3/s", "flow in", 0.02),)
    outputs = base_states
    catalogue = (Leak, Draw)
    sensors = (GaugeOffset,)
    sensor_variance = {"level": 1e-6}
    start_variance = {"level": 0.01}
    forced = ("level",)
    calibrated = ("area",)
    excursion = {"inflow": 0.015}
    rate, substep, horizon = 0.5, 0.125, 20.0

    area: float = parameter(0.5, unit="m2", bounds=(0.01, 10), doc="area of the surface")

    def equations(self, m: Namespace) -> Equations:
        """A·dh/dt = q - c·sqrt(h) - flows of the effects."""
        terms = overrides(self.awake, "loss", TankEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            (level,) = state
            flow = command[0] - 0.02 * m.sqrt(m.maximum(level, 1e-6))
            for term in terms:
                flow = flow - term.loss(m, level)
            return (flow / self.area,)

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
'''


def tank_log(path: Path, seed: int, seconds: float = 400.0, step: float = STEP) -> Path:
    """A log of a tank that leaks LEAK·h, filled in steps; the gauge has noise."""
    rng = np.random.default_rng(seed)
    time = step * np.arange(round(seconds / step) + 1)
    inflow = np.repeat(rng.uniform(0.01, 0.05, time.size // 40 + 1), 40)[: time.size]
    level = [1.0]
    for q in inflow[:-1]:

        def rate(_: float, h: np.ndarray, q: float = q) -> list[float]:
            return [(q - OUTLET * math.sqrt(max(h[0], 1e-6)) - LEAK * h[0]) / AREA]

        level.append(float(solve_ivp(rate, (0.0, step), [level[-1]], rtol=1e-9, atol=1e-12).y[0, -1]))
    read = np.array(level) + NOISE * rng.standard_normal(time.size)
    return write_log(path, {"time": time, "inflow": inflow, "level": read})


def tank_study(folder: Path) -> Path:
    """tank.py, three logs and a study."""
    (folder / "tank.py").write_text(MODEL, encoding="utf-8")
    for seed, name in enumerate(("e1.csv", "e2.csv", "v1.csv")):
        tank_log(folder / name, seed)
    study = folder / "study.yaml"
    study.write_text("model: tank.py:Tank\nlogs:\n  estimation: [e1.csv, e2.csv]\n  validation: [v1.csv]\n")
    return study
