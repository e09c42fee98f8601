"""Craft of the field half: truth and pilot of the laboratory half, with other base parameters, pushes and row times."""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
from __future__ import annotations

import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Array, Course, Entry, Flat, Look, Random, Rate, Rig, Run, Truth, sensor
from tests.blind.truth_craft import CALM, OUTPUTS, REST, SHEET, STATES, VARIANCE, Craft, Flight, Servos, equations
from tests.blind.truth_outside import OUTSIDE
from tests.blind.truth_pilot import Pilot

_DEG = math.pi / 180.0
TOLERANCE = {"mass": 0.1, "izz": 0.2, "friction": 0.3, "lag": 0.15, "thrust_slope": 0.02}


class CraftRig(Rig):
    """Craft driven by duties and tilts; outputs heading, yaw rate, acceleration and position."""

    name, model = "craft", "base"
    states = dict(zip(STATES[2:14], (1.0, 1.0, 1.0, 0.4, 0.1, 0.5, 0.02, 0.2, 0.5, 0.5, 0.1, 0.1), strict=True))
    inputs = dict(zip(("duty_right", "duty_left", "tilt_right", "tilt_left"), REST, strict=True))
    outputs = {name: math.sqrt(variance) for name, variance in VARIANCE.items()}
    sheet = {name: (SHEET[name], share) for name, share in TOLERANCE.items()}
    constants = {name: value for name, value in SHEET.items() if name not in TOLERANCE}
    entries = {
        "coulomb_friction": Entry("force", 0.01, 1e-3, 0.12),
        "stribeck_friction": Entry(
            "force", 0.01, 1e-3, 0.06, shape={"speed": (0.1, 0.2)}, ratio={"static_force": (2.2, 3.0)}
        ),
        "quadratic_drag": Entry("coefficient", 0.1, 0.01, 2.0),
        "yaw_damping": Entry("coefficient", 1e-3, 1e-4, 0.02),
        "yaw_coulomb_friction": Entry("moment", 1e-3, 1e-4, 0.012),
        "actuator_delay": Entry("time", 0.02, 2e-3, 0.15),
        "servo_rate_limit": Entry("rate", 0.7, 0.4, 3.0, inverse=True),
        "servo_backlash": Entry("width", 0.5 * _DEG, 0.1 * _DEG, 4.0 * _DEG),
        "servo_dead_band": Entry("width", 0.5 * _DEG, 0.05 * _DEG, 3.0 * _DEG),
        "tilt_offset": Entry("right left", 0.3 * _DEG, 0.02 * _DEG, 3.0 * _DEG),
        "thrust_asymmetry": Entry("ratio", 0.01, 1e-3, 0.08, signed=True),
        "battery_sag": Entry("drop", 0.1, 0.01, 0.5, shape={"time": (12.0, 18.0)}),
        "inflow_thrust_loss": Entry("coefficient", 0.1, 0.01, 0.6),
        "com_offset": Entry("right", 1e-3, 1e-4, 0.015, signed=True),
        "table_tilt": Entry("x y", 0.05 * _DEG, 5e-3 * _DEG, 0.6 * _DEG),
        "accelerometer_scale": sensor("ax", "scale", 0.05, 5e-3, 0.4),
        "accelerometer_bias": sensor("ax", "bias", 0.03, 2e-3, 0.5),
        "gyro_bias": sensor("psi_dot", "bias", 3e-3, 2e-4, 0.1),
    }
    outside = {name: Entry(next(iter(ranges)), 1.0, 1.0, 1.0, fixed=True) for name, ranges in OUTSIDE.items()}
    families = (  # never in one study: the data cannot tell them apart, or one hides the other
        frozenset({"coulomb_friction", "stribeck_friction", "quadratic_drag"}),
        frozenset({"yaw_damping", "yaw_coulomb_friction"}),
        frozenset({"actuator_second_order", "actuator_delay", "servo_rate_limit"}),
        frozenset({"servo_backlash", "servo_dead_band"}),
        frozenset({"thrust_asymmetry", "com_offset", "tilt_offset"}),
        frozenset({"battery_sag", "inflow_thrust_loss"}),
    )
    # ±12° of both tilts at the nominal thrust: a range of 2 N forward, 0.36 N m of yaw, of which a quarter is pushed
    pushes, correlation_time = (2.0, 2.0, 0.1), 1.0
    step, rows, horizon, preroll = 0.02, 2001, 2.0, 0.0
    shaping = (
        "actuator_delay.time",
        "servo_backlash.width",
        "servo_dead_band.width",
        "tilt_offset.right",
        "tilt_offset.left",
    )

    def acting(self, p: Flat, run: Run, parts: int) -> Array:
        """Return the mean command over each row after delay, play, offset and dead band of the servos."""
        servos = Servos({key: float(p[key]) for key in self.shaping if key in p})
        ends = np.append(run.times[1:], run.times[-1] + self.step)
        rows = []
        for begin, end, command in zip(run.times.tolist(), ends.tolist(), run.commands.tolist(), strict=True):
            pieces = servos.pieces(begin, end, tuple(command))
            rows.append([sum((b - a) * u[i] for a, b, u in pieces) / (end - begin) for i in range(4)])
        return np.repeat(np.array(rows)[:, None, :], parts, axis=1)

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return the equations of the craft without odometers and rates of the tilts."""
        rate, look = equations(
            f, p, lambda vf, vs: f.sqrt(vf * vf + vs * vs + 1e-12),
            lambda force, slip: force * f.tanh(slip / 0.01) / slip,
        )  # fmt: skip
        shown = [OUTPUTS.index(name) for name in self.outputs]

        def whole(x: Any) -> list[Any]:
            return [0.0, 0.0, *x, 0.0, 0.0]

        def outputs(t: Any, x: Any, push: Any) -> list[Any]:
            values = look(t, whole(x), push)
            return [values[k] for k in shown]

        return lambda t, x, u, push: rate(t, whole(x), u, push)[2:14], outputs


def craft(base: dict[str, float], truth: Truth) -> Craft:
    """Return the craft with wrong base parameters and effects, without errors of sensors."""
    return Craft(base, {name: values for name, values in truth.items() if name not in CraftRig().sensors})


def moving_start(rng: Random) -> dict[str, float]:
    """Return the start state of a log: with probability ½ at rest at the origin, else moving."""
    if rng.random() < 0.5:
        return {}
    spread = {"x_world": 0.5, "y_world": 0.5, "psi": 1.0, "vx": 0.4, "vy": 0.1, "psi_dot": 0.5}
    return {name: float(rng.uniform(-width, width)) for name, width in spread.items()}


def fly_craft(
    craft: Craft, start: dict[str, float], pilot: Pilot, truth: Truth, inputs: tuple[Array, ...], channels: int = 5
) -> tuple[Run, Course]:
    """Simulate a log in closed loop; the pilot uses readings with sensor noise, without the recorder's faults.

    Args:
        craft: with its effects.
        start: states of the craft that are not those of rest.
        pilot: gives the commands.
        truth: with the errors of the sensors.
        inputs: times, disturbances and noise of the sensors.
        channels: how many of the outputs the pilot sees.
    """
    rig, flight, (times, pushes, noise) = CraftRig(), Flight(craft, craft.rest(**start)), inputs
    p = rig.numbers({}, truth)
    readings, states, commands = [], [], []
    for k, push in enumerate(map(tuple, pushes.tolist())):
        readings.append([rig.sensed(p, output, value) for output, value in shown(flight, push).items()])
        states.append(flight.state.copy())
        cells = zip(rig.outputs, readings[k] + noise[k], strict=True)
        seen = {output: float(f"{cell:.6g}") for output, cell in list(cells)[:channels]}
        commands.append(pilot.command(seen))
        if k + 1 < times.size:
            flight.advance(commands[-1], push, float(times[k + 1]))
    return Run(times, np.array(commands), pushes, states[0][2:14]), Course(np.array(readings), np.array(states))


def shown(flight: Flight, push: Any) -> dict[str, float]:
    """Return the readings of right sensors."""
    now = flight.outputs(push)
    return {output: now[output] for output in CraftRig.outputs}


def replay_craft(made: Craft, truth: Truth, run: Run, course: Course) -> Array:
    """Return readings of replays over one horizon each, from the true state without pushes; NaN in the first 2 s."""
    rig = CraftRig()
    horizon, last = round(rig.horizon / rig.step), run.times.size - 1
    times, commands = run.times.tolist(), [tuple(command) for command in run.commands.tolist()]
    right = np.full(course.readings.shape, np.nan)
    for k in range(horizon, last, horizon):
        flight = Flight(made, course.states[k].copy(), times[k])
        for j in range(k):  # the servos remember: play, and what is outside
            flight.servos.pieces(times[j], times[j + 1], commands[j])
        for j in range(k, min(k + horizon, last)):
            flight.advance(commands[j], end=times[j + 1])
            right[j + 1] = list(shown(flight, CALM).values())
    return rig.all_sensed(rig.numbers({}, truth), right)
