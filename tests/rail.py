"""A mass on a rail and a spring as a model of one's own, and logs of real ones: by code apart from the model's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.logs import write_log

MODEL = '''"""A mass on a rail, between a spring and a motor."""

from dataclasses import dataclass

from cosim.model import Bias, Delay, Effect, Equations, Latency, Model, Quantity, overrides, parameter


class RailEffect(Effect):
    """A force that the base model lacks, or a motor of its own dynamics."""

    def force(self, m, x, v):
        return 0.0

    def motor(self, m, u, states):
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Late(Delay, RailEffect):
    name = "late_motor"
    memory = (Quantity("force", "N", "force that acts until the delay has passed"),)


@dataclass(frozen=True, kw_only=True)
class Soft(RailEffect):
    name = "soft_motor"
    equation = "f'' = w^2 (u - f) - 1.2 w f', f in place of u"
    states = (Quantity("force", "N", "force"), Quantity("rate", "N/s", "its rate"))
    frequency: float = parameter(0.0, unit="rad/s", bounds=(0, 100), neutral=0.0, typical=20.0, doc="w; 0 = off")

    def motor(self, m, u, states):
        w = self.frequency
        return m.where(w > 0.0, states[0], u), (states[1], w * w * (u - states[0]) - 1.2 * w * states[1])


@dataclass(frozen=True, kw_only=True)
class Coulomb(RailEffect):
    name = "coulomb"
    equation = "force -F tanh(v/0.02)"
    level: float = parameter(0.0, unit="N", bounds=(0, 5), neutral=0.0, typical=0.5, doc="dry friction F")

    def force(self, m, x, v):
        return -self.level * m.tanh(v / 0.02)


@dataclass(frozen=True, kw_only=True)
class Stribeck(RailEffect):
    name = "stribeck"
    equation = "force -(F + (S - F) exp(-(v/c)^2)) tanh(v/0.02)"
    at_least = {"rest": "sliding"}
    sliding: float = parameter(0.0, unit="N", bounds=(0, 5), neutral=0.0, typical=0.5, doc="F, in motion")
    rest: float = parameter(0.0, unit="N", bounds=(0, 5), neutral=0.0, typical=1.0, doc="S, at rest")
    speed: float = parameter(0.1, unit="m/s", bounds=(0.02, 1), doc="Stribeck speed c")

    def force(self, m, x, v):
        level = self.sliding + (self.rest - self.sliding) * m.exp(-((v / self.speed) ** 2))
        return -level * m.tanh(v / 0.02)


@dataclass(frozen=True, kw_only=True)
class Drag(RailEffect):
    name = "drag"
    equation = "force -k |v| v"
    factor: float = parameter(0.0, unit="N.s2/m2", bounds=(0, 50), neutral=0.0, typical=3.0, doc="k")

    def force(self, m, x, v):
        return -self.factor * m.where(v >= 0.0, v, -v) * v


@dataclass(frozen=True, kw_only=True)
class Hardening(RailEffect):
    name = "hardening"
    equation = "force -k x^3"
    factor: float = parameter(0.0, unit="N/m3", bounds=(-1e4, 1e4), neutral=0.0, typical=200.0, doc="k")

    def force(self, m, x, v):
        return -self.factor * x * x * x


@dataclass(frozen=True, kw_only=True)
class Slope(RailEffect):
    name = "slope"
    equation = "force f"
    pull: float = parameter(0.0, unit="N", bounds=(-5, 5), neutral=0.0, typical=0.3, doc="f")

    def force(self, m, x, v):
        return self.pull


@dataclass(frozen=True, kw_only=True)
class FarStop(RailEffect):
    name = "far_stop"
    equation = "force -k (x - 0.8) beyond 0.8 m"
    stiffness: float = parameter(0.0, unit="N/m", bounds=(0, 1e4), neutral=0.0, typical=100.0, doc="k")

    def force(self, m, x, v):
        return -self.stiffness * m.maximum(0.0, x - 0.8)


@dataclass(frozen=True, kw_only=True)
class BackStop(RailEffect):
    name = "back_stop"
    equation = "force k (-0.8 - x) beyond -0.8 m"
    stiffness: float = parameter(0.0, unit="N/m", bounds=(0, 1e4), neutral=0.0, typical=100.0, doc="k")

    def force(self, m, x, v):
        return self.stiffness * m.maximum(0.0, -0.8 - x)


@dataclass(frozen=True, kw_only=True)
class CameraLate(Latency):
    name = "camera_late"
    output = "position"
    outputs = ("position",)


@dataclass(frozen=True, kw_only=True)
class GyroBias(Bias):
    name = "speed_bias"
    output = "velocity"
    value: float = parameter(0.0, unit="m/s", bounds=(-1, 1), neutral=0.0, typical=0.02, doc="bias")


@dataclass(frozen=True, kw_only=True)
class Rail(Model):
    """m v' = u - b v - k x + forces of the effects."""

    title = "Rail"
    base_states = (Quantity("position", "m", "position"), Quantity("velocity", "m/s", "velocity"))
    inputs = (Quantity("force", "N", "force of the motor commanded"),)
    outputs = base_states
    catalogue = (Late, Soft, Coulomb, Stribeck, Drag, Hardening, Slope, FarStop, BackStop)
    sensors = (CameraLate, GyroBias)
    sensor_variance = {"position": 1e-6, "velocity": 1e-4}
    start_variance = {"position": 0.01, "velocity": 0.04}
    forced = ("velocity",)
    calibrated = ("mass", "viscous", "spring")
    substep, rate, horizon = 0.005, 0.02, 2.0
    mass: float = parameter(2.0, unit="kg", bounds=(0.1, 100), doc="m")
    viscous: float = parameter(4.0, unit="N.s/m", bounds=(0, 200), doc="b")
    spring: float = parameter(50.0, unit="N/m", bounds=(1, 1000), doc="k")

    def equations(self, m):
        forces = overrides(self.awake, "force", RailEffect)
        motors = overrides(self.awake, "motor", RailEffect)

        def derivative(t, state, command):
            x, v, *own = state
            u, slopes = command[0], ()
            for term in motors:
                u, slopes = term.motor(m, u, tuple(own))
            total = u - self.viscous * v - self.spring * x
            for term in forces:
                total = total + term.force(m, x, v)
            return v, total / self.mass, *slopes

        return Equations(derivative, lambda t, state, command: tuple(state[:2]))
'''
STEP, FINE = 0.02, 8
SHEET = {"mass": 2.0, "viscous": 4.0, "spring": 50.0}
NOISE = {"position": 1e-3, "velocity": 1e-2}
Rows = np.ndarray
Recorder = Callable[[Rows, Rows, np.random.Generator], Rows]  # of true readings and their rates [1/s]: what is written
Pull = Callable[[float, float], float]  # of position and velocity


def steps(rng: np.random.Generator, rows: int, size: float = 12.0) -> Rows:
    """Forces that change at irregular times."""
    u, k = np.zeros(rows), 0
    while k < rows:
        lasting = int(rng.integers(8, 50))
        u[k : k + lasting] = rng.uniform(-size, size)
        k += lasting
    return u


def moved(
    u: Rows, numbers: Mapping[str, float] = SHEET, pull: Pull | None = None, push: Rows | None = None
) -> tuple[Rows, Rows]:
    """Position, velocity and their rates, a row each, by Runge-Kutta in eight parts of a row; `push` [N] is held."""
    p = {
        **SHEET,
        **dict.fromkeys(("coulomb", "drag", "hardening", "slope", "sliding", "rest", "fades"), 0.0),
        **numbers,
    }
    m, b, k, dry = (p[n] for n in ("mass", "viscous", "spring", "coulomb"))
    late, w = round(p.get("late", 0.0) / STEP * FINE), p.get("soft", 0.0)
    held = np.repeat(u, FINE)
    held = np.concatenate([np.full(late, u[0]), held])[: held.size]
    pushed = np.zeros(held.size) if push is None else np.repeat(push, FINE)

    def rate(state: tuple[float, ...], given: float, beside: float) -> tuple[float, ...]:
        x, v, f, df = state
        acts = f if w else given
        level = dry + p["sliding"] + (p["rest"] - p["sliding"]) * math.exp(-((v / 0.1) ** 2))
        damping = b * (1.0 - p["fades"] * i / held.size)
        total = acts + beside - damping * v - k * x - level * math.tanh(v / 0.02)
        total += -p["drag"] * abs(v) * v - p["hardening"] * x**3 + p["slope"] + (pull(x, v) if pull else 0.0)
        return v, total / m, df, w * w * (given - f) - 1.2 * w * df

    def ahead(state: tuple[float, ...], slope: tuple[float, ...], h: float) -> tuple[float, ...]:
        return tuple(a + h * s for a, s in zip(state, slope, strict=True))

    i, h, state, states, rates = 0, STEP / FINE, (0.0, 0.0, 0.0, 0.0), [], []
    for i, (given, beside) in enumerate(zip(held.tolist(), pushed.tolist(), strict=True)):
        a = rate(state, given, beside)
        if i % FINE == 0:
            states.append(state[:2])
            rates.append(a[:2])
        c = rate(ahead(state, a, h / 2), given, beside)
        d = rate(ahead(state, c, h / 2), given, beside)
        e = rate(ahead(state, d, h), given, beside)
        state = tuple(s + h / 6 * (q + 2 * r + 2 * t + z) for s, q, r, t, z in zip(state, a, c, d, e, strict=True))
    return np.array(states), np.array(rates)


def lasting(rng: np.random.Generator, rows: int, size: float, seconds: float = 1.0) -> Rows:
    """A disturbance of this standard deviation, forgotten within so many seconds."""
    keep = math.exp(-STEP / seconds)
    pushed, now = np.empty(rows), size * rng.standard_normal()
    for k in range(rows):
        pushed[k] = now
        now = keep * now + size * math.sqrt(1.0 - keep * keep) * rng.standard_normal()
    return pushed


def white(true: Rows, rates: Rows, rng: np.random.Generator) -> Rows:
    """Return a log from correct sensors with white noise."""
    return true + np.array(list(NOISE.values())) * rng.standard_normal(true.shape)


def rail_log(
    path: Path,
    seed: int,
    numbers: Mapping[str, float] = SHEET,
    *,
    seconds: float = 12.0,
    recorder: Recorder = white,
    pull: Pull | None = None,
    push: float = 0.0,
) -> Path:
    """A log of a rail of these numbers, by a recorder, with a pull of its own and a lasting disturbance [N]."""
    rng = np.random.default_rng(seed)
    rows = round(seconds / STEP)
    u = steps(rng, rows)
    true, rates = moved(u, numbers, pull, lasting(rng, rows, push) if push else None)
    read = recorder(true, rates, rng)
    return write_log(path, {"time": STEP * np.arange(rows), "force": u, "position": read[:, 0], "velocity": read[:, 1]})


def rail_study(folder: Path, numbers: Mapping[str, float] = SHEET, more: str = "", seed: int = 0, **how: Any) -> Path:
    """Write rail.py, two estimation logs, a sealed log and a study with further lines; return the study."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rail.py").write_text(MODEL, encoding="utf-8")
    for k, name in enumerate(("a", "b", "c")):
        rail_log(folder / f"{name}.csv", 10 * seed + k, numbers, **how)
    path = folder / "study.yaml"
    path.write_text(f"model: rail.py:Rail\nlogs: {{estimation: [a.csv, b.csv], validation: [c.csv]}}\n{more}")
    return path
