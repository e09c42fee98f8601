"""Blind studies of the laboratory half: `draw(seed)` draws a study, `write(study, folder)` writes its logs.

A study has two estimation logs and a sealed log of 40 s at 50 Hz, in closed loop with the pilot of `truth_pilot` and
the craft of `truth_craft`. Row k holds the measurement at t_k and the command that acts from t_k on.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from tests.blind.truth_craft import STEP, Command, Craft, Flight, Outside
from tests.blind.truth_outside import outside
from tests.blind.truth_pilot import Pilot, Style
from tests.blind.truth_study import BASE, SENSORS, Study, draw, stream

LOGS = ("e1", "e2", "v1")
DURATION = 40.0
IMU = ("psi", "psi_dot", "ax")
POSITION = ("x_world", "y_world")
# eq 5.46, and a camera of 1 mm
VARIANCE = {"psi": 2.613e-5, "psi_dot": 4.564e-4, "ax": 0.04479, "x_world": 1e-6, "y_world": 1e-6}
DISTURBANCE = (0.004, 0.004, 0.0002)  # forward, starboard [N], yaw [N m]: standard deviations
CORRELATION_TIME = 1.0  # [s]

__all__ = ["LOGS", "Log", "Study", "answer", "craft_of", "draw", "fly", "study_yaml", "write"]


@dataclass
class Log:
    """A simulated flight: the log, and the unlogged states, disturbance and noise-free sensor readings."""

    channels: tuple[str, ...]
    time: np.ndarray
    commands: list[Command]
    measured: dict[str, np.ndarray]
    states: np.ndarray
    noiseless: dict[str, np.ndarray]
    disturbance: np.ndarray
    start: dict[str, float] = field(default_factory=dict)


def craft_of(study: Study) -> Craft:
    """Return the craft of a study, with wrong base parameters, effects, or an effect outside the catalogue."""
    base = {n: v["value"] for n, v in study.truth.items() if n in BASE}
    effects = {n: v for n, v in study.truth.items() if n not in BASE and n not in SENSORS}
    if study.kind == "outside":
        (name,) = study.truth
        return Craft(outside=outside(name, study.truth[name]))
    return Craft(base=base, effects=effects)


def _coloured(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return stationary first-order Gauss-Markov samples of `DISTURBANCE`, shape (count, 3)."""
    keep = math.exp(-STEP / CORRELATION_TIME)
    white = rng.standard_normal((count, 3))
    values = np.empty((count, 3))
    values[0] = white[0]
    for k in range(1, count):
        values[k] = keep * values[k - 1] + math.sqrt(1.0 - keep * keep) * white[k]
    return values * DISTURBANCE


def _moving(rng: np.random.Generator) -> dict[str, float]:
    """Return the start state of a log: with probability ½ at rest at the origin, else moving."""
    if rng.random() < 0.5:
        return {}
    spread = {"x_world": 0.5, "y_world": 0.5, "psi": 1.0, "vx": 0.4, "vy": 0.1, "psi_dot": 0.5}
    start = {name: float(rng.uniform(-width, width)) for name, width in spread.items()}
    return start | {"tilt_right": float(rng.normal(0.0, 0.03)), "tilt_left": float(rng.normal(0.0, 0.03))}


def fly(study: Study, number: int, tolerance: float = 1e-9, duration: float = DURATION) -> Log:
    """Return log `number` of a study."""
    count = round(duration / STEP) + 1
    manoeuvre, noise, shove = (stream(study.seed, 10 + number, purpose) for purpose in range(3))
    start = _moving(manoeuvre)
    craft = craft_of(study)
    flight = Flight(craft, craft.rest(**start), tolerance=tolerance)
    pilot = Pilot(manoeuvre, Style.draw(manoeuvre, study.duty_varied), count, start.get("psi", 0.0))
    disturbance = _coloured(shove, count) if study.disturbed else np.zeros((count, 3))
    channels = (*IMU, *POSITION) if study.position else IMU
    errors = {c: math.sqrt(VARIANCE[c]) * noise.standard_normal(count) for c in (*IMU, *POSITION)}
    measured = {c: np.empty(count) for c in channels}
    noiseless = {c: np.empty(count) for c in (*IMU, *POSITION)}
    states, commands = np.empty((count, flight.state.size)), []
    for k in range(count):
        push = tuple(float(d) for d in disturbance[k])
        flight.dynamics.disturbance = push  # type: ignore[assignment]
        now = flight.outputs()
        for c in noiseless:
            noiseless[c][k] = _sensed(study, craft.outside, c, now[c])
        seen = {c: float(f"{noiseless[c][k] + errors[c][k]:.6g}") for c in channels}
        for c in channels:
            measured[c][k] = seen[c]
        states[k] = flight.state
        commands.append(pilot.command(seen))
        if k + 1 < count:
            flight.advance(commands[-1], push)  # type: ignore[arg-type]
    return Log(channels, np.arange(count) * STEP, commands, measured, states, noiseless, disturbance, start)


def _sensed(study: Study, stranger: Outside, channel: str, value: float) -> float:
    """Return the reading of a sensor without noise."""

    def error(name: str, neutral: float) -> float:
        return study.truth.get(name, {}).get("value", neutral)

    if channel == "ax":
        return value * error("accelerometer_scale", 1.0) + error("accelerometer_bias", 0.0)
    if channel == "psi_dot":
        return value + error("gyro_bias", 0.0)
    if channel == "psi" and stranger.compass:
        return stranger.compass(value)
    return value


def _csv(log: Log) -> str:
    lines = [",".join(("time", "duty_right", "duty_left", "tilt_right", "tilt_left", *log.channels))]
    for k, command in enumerate(log.commands):
        cells = (*command, *(log.measured[c][k] for c in log.channels))
        lines.append(f"{log.time[k]:.2f}," + ",".join(f"{v:.6g}" for v in cells))
    return "\n".join(lines) + "\n"


def study_yaml() -> str:
    """Return the study file, independent of hidden effects."""
    return "model: base\nlogs:\n  estimation: [e1.csv, e2.csv]\n  validation: [v1.csv]\n"


def write(study: Study, folder: Path, duration: float = DURATION) -> Path:
    """Write study.yaml and the three logs, without the answer; return the path of study.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(LOGS):
        (folder / f"{name}.csv").write_text(_csv(fly(study, number, duration=duration)))
    path = folder / "study.yaml"
    path.write_text(study_yaml())
    return path


def answer(study: Study) -> str:
    """Return the answer as JSON, to be opened after the verdict."""
    return json.dumps(asdict(study), indent=1) + "\n"
