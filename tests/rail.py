"""A mass on a rail and a spring as a model of one's own, and logs of real ones: by code apart from the model's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from tests.logs import write_log

MODEL = '''"""A mass on a rail, between a spring and a motor."""

from dataclasses import dataclass

from cosim.model import DryFriction, Equations, Latency, LocalEffect, Model, Quantity, parameter, size


def rubs(e, m, force, v, x):
    level = e.sliding + (e.rest - e.sliding) * m.exp(-((v / e.speed) ** 2))
    return force - level * m.tanh(v / 0.02)


CATALOGUE = (
    DryFriction.named("coulomb", place="rail", softness=0.02, level=size("N", (0, 5), 0.5, "dry friction")),
    LocalEffect.named(
        "stribeck", place="rail", equation="force -(F + (S - F) exp(-(v/c)^2)) tanh(v/0.02)", change=rubs,
        at_least={"rest": "sliding"},
        sliding=size("N", (0, 5), 0.5, "F, in motion"), rest=size("N", (0, 5), 1.0, "S, at rest"),
        speed=parameter(0.1, unit="m/s", bounds=(0.02, 1), doc="Stribeck speed c"),
    ),
    LocalEffect.named(
        "drag", place="rail", equation="force -k |v| v", factor=size("N.s2/m2", (0, 50), 3.0, "k"),
        change=lambda e, m, force, v, x: force - e.factor * m.where(v >= 0.0, v, -v) * v,
    ),
    LocalEffect.named(
        "hardening", place="rail", equation="force -k x^3", factor=size("N/m3", (-1e4, 1e4), 200.0, "k"),
        change=lambda e, m, force, v, x: force - e.factor * x * x * x,
    ),
    LocalEffect.named(
        "slope", place="rail", equation="force f", pull=size("N", (-5, 5), 0.3, "f"),
        change=lambda e, m, force, v, x: force + e.pull,
    ),
    LocalEffect.named(
        "far_stop", place="rail", equation="force -k (x - 0.8) beyond 0.8 m",
        stiffness=size("N/m", (0, 1e4), 100.0, "k"),
        change=lambda e, m, force, v, x: force - e.stiffness * m.maximum(0.0, x - 0.8),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Rail(Model):
    """m v' = u - b v - k x + forces of the effects."""

    title = "Rail"
    base_states = (Quantity("position", "m", "position"), Quantity("velocity", "m/s", "velocity"))
    inputs = (Quantity("force", "N", "force of the motor commanded"),)
    outputs = base_states
    catalogue, places = CATALOGUE, ("rail",)
    sensors = (Latency.named("camera_late", outputs=("position",)),)
    sensor_variance = {"position": 1e-6, "velocity": 1e-4}
    start_variance = {"position": 0.01, "velocity": 0.04}
    forced = ("velocity",)
    calibrated = ("mass", "viscous", "spring")
    substep, rate, horizon = 0.005, 0.02, 2.0
    mass: float = parameter(2.0, unit="kg", bounds=(0.1, 100), doc="m")
    viscous: float = parameter(4.0, unit="N.s/m", bounds=(0, 200), doc="b")
    spring: float = parameter(50.0, unit="N/m", bounds=(1, 1000), doc="k")

    def equations(self, m):
        at = self.effects_at(m)

        def derivative(t, state, command):
            x, v = state
            return v, at("rail", command[0] - self.viscous * v - self.spring * x, v, x) / self.mass

        return Equations(derivative, lambda t, state, command: tuple(state))
'''
STEP, FINE, ROWS = 0.02, 8, 600
SHEET = {"mass": 2.0, "viscous": 4.0, "spring": 50.0}
ABSENT = dict.fromkeys(("coulomb", "drag", "hardening", "slope", "sliding", "rest", "fades"), 0.0)
NOISE = {"position": 1e-3, "velocity": 1e-2}
Rows = np.ndarray
Recorder = Callable[[Rows, Rows, np.random.Generator], Rows]  # of true readings and their rates [1/s]: what is written


def steps(rng: np.random.Generator, size: float = 12.0) -> Rows:
    """Forces that change at irregular times."""
    u, k = np.zeros(ROWS), 0
    while k < ROWS:
        lasting = int(rng.integers(8, 50))
        u[k : k + lasting] = rng.uniform(-size, size)
        k += lasting
    return u


def lasting(rng: np.random.Generator, size: float) -> Rows:
    """A disturbance of this standard deviation, forgotten within a second."""
    keep = math.exp(-STEP)
    pushed, now = np.empty(ROWS), size * rng.standard_normal()
    for k in range(ROWS):
        pushed[k] = now
        now = keep * now + size * math.sqrt(1.0 - keep * keep) * rng.standard_normal()
    return pushed


def moved(u: Rows, numbers: Mapping[str, float]) -> tuple[Rows, Rows]:
    """Position, velocity and their rates, a row each, by Runge-Kutta in eight parts of a row."""
    p = {**ABSENT, **SHEET, **numbers}
    held = np.repeat(u, FINE).tolist()

    def rate(i: int, state: Rows) -> Rows:
        x, v = state.tolist()
        level = p["coulomb"] + p["sliding"] + (p["rest"] - p["sliding"]) * math.exp(-((v / 0.1) ** 2))
        damping = p["viscous"] * (1.0 - p["fades"] * i / len(held))
        total = held[i] - damping * v - p["spring"] * x - level * math.tanh(v / 0.02)
        total += -p["drag"] * abs(v) * v - p["hardening"] * x**3 + p["slope"]
        return np.array([v, total / p["mass"]])

    h, state, rows = STEP / FINE, np.zeros(2), []
    for i in range(len(held)):
        a = rate(i, state)
        if i % FINE == 0:
            rows.append((state, a))
        c = rate(i, state + h / 2 * a)
        d = rate(i, state + h / 2 * c)
        state = state + h / 6 * (a + 2 * c + 2 * d + rate(i, state + h * d))
    states, rates = np.array(rows).swapaxes(0, 1)
    return states, rates


def white(true: Rows, rates: Rows, rng: np.random.Generator) -> Rows:
    """Return a log from correct sensors with white noise."""
    return true + np.array(list(NOISE.values())) * rng.standard_normal(true.shape)


def rail_study(
    folder: Path, numbers: Mapping[str, float], more: str = "", recorder: Recorder = white, push: float = 0.0
) -> Path:
    """Write rail.py, two estimation logs, a sealed log, by a recorder, and a study with further lines; return it.

    Beside the motor acts a lasting disturbance of the size `push` [N], which is not logged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rail.py").write_text(MODEL, encoding="utf-8")
    for seed, name in enumerate(("a", "b", "c")):
        rng = np.random.default_rng(seed)
        u = steps(rng)
        acts = u + lasting(rng, push) if push else u
        position, velocity = recorder(*moved(acts, numbers), rng).T
        columns = {"time": STEP * np.arange(ROWS), "force": u, "position": position, "velocity": velocity}
        write_log(folder / f"{name}.csv", columns)
    path = folder / "study.yaml"
    path.write_text(f"model: rail.py:Rail\nlogs: {{estimation: [a.csv, b.csv], validation: [c.csv]}}\n{more}")
    return path
