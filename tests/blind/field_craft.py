"""Craft of the field half: truth and pilot of the laboratory half, with other base parameters, pushes and row times."""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
import math
from typing import Any

import numpy as np

from tests.blind.field_rig import Array, Course, Entry, Flat, Look, Random, Rate, Rig, Run, Truth, sensor
from tests.blind.truth_craft import (
    CALM,
    DEGREE,
    DUTY,
    OUTPUTS,
    OUTSIDE,
    REST,
    SHEET,
    STATES,
    STEP,
    TILT_MAX,
    VARIANCE,
    Command,
    Craft,
    Flight,
    Servos,
    equations,
)  # fmt: skip

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
        "servo_backlash": Entry("width", 0.5 * DEGREE, 0.1 * DEGREE, 4.0 * DEGREE),
        "servo_dead_band": Entry("width", 0.5 * DEGREE, 0.05 * DEGREE, 3.0 * DEGREE),
        "tilt_offset": Entry("right left", 0.3 * DEGREE, 0.02 * DEGREE, 3.0 * DEGREE),
        "thrust_asymmetry": Entry("ratio", 0.01, 1e-3, 0.08, signed=True),
        "battery_sag": Entry("drop", 0.1, 0.01, 0.5, shape={"time": (12.0, 18.0)}),
        "inflow_thrust_loss": Entry("coefficient", 0.1, 0.01, 0.6),
        "com_offset": Entry("right", 1e-3, 1e-4, 0.015, signed=True),
        "table_tilt": Entry("x y", 0.05 * DEGREE, 5e-3 * DEGREE, 0.6 * DEGREE),
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


# -- pilot ---------------------------------------------------------------------------------------------------

THRUST = 2.4973  # nominal thrust of a propeller in ground effect, eq 5.36 [N]
Range = tuple[float, float]


def reference(rng: Random, count: int, size: Range, rate: Range, pause: Range) -> Array:
    """Return steps and ramps: changes of ±`size`, half of them with a random `rate`, each followed by a `pause`."""
    values = np.zeros(count)
    target = 0.0
    k = int(rng.uniform(0.2, 1.5) / STEP)
    while k < count:
        change = rng.uniform(*size) * rng.choice([-1.0, 1.0])
        if abs(target + change) > 1.5 * size[1]:
            change = -change
        limit = math.inf if rng.random() < 0.5 else rng.uniform(*rate)
        ramp = np.minimum(np.arange(1, count - k + 1) * STEP * limit if limit < math.inf else abs(change), abs(change))
        values[k:] = target + math.copysign(1.0, change) * ramp
        target += change
        ahead = abs(change) / limit + rng.uniform(*pause)
        k += int(ahead / STEP)
    return values


def telegraph(rng: Random, count: int, amplitude: float, hold: Range) -> Array:
    """Return random levels within ±`amplitude`, each held for a time within `hold` [s]: broadband, down to DC."""
    values = np.zeros(count)
    k = 0
    while k < count:
        length = max(1, int(rng.uniform(*hold) / STEP))
        values[k : k + length] = amplitude * rng.uniform(-1.0, 1.0)
        k += length
    return values


class Pilot:
    """Observer and feedback, with distance and speed from the accelerometer and, if measured, the position."""

    def __init__(self, rng: Random, duty_varied: bool, count: int, heading: float) -> None:
        self.forward_gain, self.yaw_gain = rng.uniform(0.7, 1.1), rng.uniform(0.6, 0.9)
        common, turning = rng.uniform(0.03, 0.045), rng.uniform(0.03, 0.05)  # amplitudes of the dither [rad], [%]
        power = rng.uniform(0.08, 0.11) if duty_varied else 0.0
        self.distance_ref = reference(rng, count, (0.2, 1.4), (0.1, 0.6), (1.0, 4.0))
        self.heading_ref = heading + reference(rng, count, (0.3, 2.0), (0.25, 1.2), (0.5, 2.5))
        self.common = telegraph(rng, count, common, (0.04, 0.5))
        self.turning = telegraph(rng, count, turning, (0.04, 0.4))
        self.power = telegraph(rng, count, power, (0.3, 2.0))
        self.balance = telegraph(rng, count, 0.3 * power, (0.2, 1.0))
        self.k = 0
        self.distance = self.speed = self.pull = 0.0  # along the craft's axis [m, m/s, m/s²]
        self.heading, self.rate = heading, 0.0
        self.travelled = 0.0
        self.place: tuple[float, float] | None = None

    def _observe(self, seen: dict[str, float]) -> None:
        c_m = SHEET["friction"] / SHEET["mass"]
        # heading: gyro integrated, drawn to the compass; rate: gyro smoothed
        self.rate += 0.6 * (seen["psi_dot"] - self.rate)
        self.heading += STEP * self.rate
        self.heading += 0.3 * (seen["psi"] - self.heading)
        # speed: thrust acceleration less friction, drawn to the accelerometer
        expected = self.pull - c_m * self.speed
        self.speed += STEP * (expected + 0.3 * (seen["ax"] - expected))
        self.distance += STEP * self.speed
        if "x_world" not in seen:
            return
        here = seen["x_world"], seen["y_world"]
        if self.place:
            step = here[0] - self.place[0], here[1] - self.place[1]
            self.travelled += step[0] * math.cos(self.heading) + step[1] * math.sin(self.heading)
        self.place = here
        error = self.travelled - self.distance
        self.distance += 0.1 * error
        self.speed += 0.2 * error

    def command(self, seen: dict[str, float]) -> Command:
        """Return the command for a measurement of the same instant."""
        self._observe(seen)
        k = self.k
        self.k += 1
        ahead = 0.70 * (self.distance_ref[k] - self.distance) - 0.65 * self.speed
        turn = 0.22 * (self.heading_ref[k] - self.heading) - 0.11 * self.rate
        common = self.forward_gain * ahead + self.common[k]
        turning = self.yaw_gain * turn + self.turning[k]
        right = min(max(common + turning, -TILT_MAX), TILT_MAX)
        left = min(max(common - turning, -TILT_MAX), TILT_MAX)
        goal = 2.0 * THRUST / SHEET["mass"] * math.sin(0.5 * (right + left))
        self.pull += STEP / SHEET["lag"] * (goal - self.pull)
        duty = DUTY + self.power[k], DUTY + self.power[k]
        duty = duty[0] + self.balance[k], duty[1] - self.balance[k]
        # what is logged is what is sent, to the last digit
        return tuple(float(f"{u:.6g}") for u in (*duty, right, left))  # type: ignore[return-value]


# -- flights -------------------------------------------------------------------------------------------------


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
