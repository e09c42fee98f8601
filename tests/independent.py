"""The model written a second time, from the equations alone: the measure of the plant's code.

Nothing here comes from the packages under test. Forces and arms are vectors in a right-handed body
frame (forward, left, up), so that every sign follows from a cross product instead of being copied;
time is integrated by DOP853 with rtol 1e-11, restarted wherever the acting command jumps.
`flown` drives the code under test (any stepper) over the same commands, so that both are read alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Effects = Mapping[str, Mapping[str, float]]

HOLD = 0.02  # [s], Fig 4.8
HOVER = 6.38763  # [%]
# Symbols of the parameter table of the thesis: §5.2, eqs 5.3, 5.4, 4.20, 4.28, 4.29, §5.5; k_t, d_t are not in it.
NUMBERS: dict[str, float] = {
    "m": 0.705, "L": 0.17145, "Izz": 0.01023, "Ixx": 0.009377, "R": 0.127, "z": 0.095, "a": -2076.0, "b": 359.9,
    "k": 1.902, "tau": 0.0884, "c": 0.25, "k_t": 5.0, "d_t": 0.45, "g": 9.81, "own_height": 1.0,
}  # fmt: skip
COLUMNS = (
    "x", "y", "x_world", "y_world", "psi", "phi", "vx", "vy", "psi_dot", "phi_dot",
    "ax", "thrust_right", "thrust_left", "tilt_right_actual", "tilt_left_actual",
)  # fmt: skip
OWN_ORDER = (
    "x_world", "y_world", "psi", "phi", "x", "y", "vx", "vy", "psi_dot", "phi_dot",
    "tilt_right", "tilt_left", "thrust_right", "thrust_left", "swing_right", "swing_left",
)  # fmt: skip


def cross(p: Vector, q: Vector) -> Vector:
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


def static_thrust(n: Mapping[str, float], duty: float) -> float:
    """[N], eq 4.20."""
    grams = n["a"] + n["b"] * duty
    return grams * n["g"] / 1000.0 if grams > 0.0 else 0.0


def gain_near_ground(n: Mapping[str, float], height: float) -> float:
    """Eq 4.23 with Z̄ = z/R and k of eq 4.28; the lowest height planned in §4.4 is R/2."""
    z_bar = max(height / n["R"], 0.5)
    return 1.0 / (1.0 - (1.0 / (4.0 * z_bar)) ** n["k"])


def forces(n: Mapping[str, float], fx: Effects, t: float, s: Sequence[float]) -> dict[str, Any]:
    """Contact forces and moments at time t: forward, left [N]; yaw (left turn), roll (right side up) [N m]."""
    phi, vx, vy, yaw_rate, roll_rate = s[3], s[6], s[7], s[8], s[9]
    lift = n["L"] * math.sin(phi) * n["own_height"]
    thrust = [s[12] * gain_near_ground(n, n["z"] + lift), s[13] * gain_near_ground(n, n["z"] - lift)]
    common = 1.0
    if "battery_sag" in fx:
        p, theta = fx["battery_sag"]["drop"], fx["battery_sag"]["time"]
        common *= (1.0 - p) + p * math.exp(-t / theta)
    if "inflow_thrust_loss" in fx:
        common *= 1.0 - fx["inflow_thrust_loss"]["coefficient"] * vx
    unequal = fx.get("thrust_asymmetry", {}).get("ratio", 0.0)
    thrust = [thrust[0] * common * (1.0 + unequal), thrust[1] * common * (1.0 - unequal)]

    e = fx.get("com_offset", {}).get("right", 0.0)
    moment = [0.0, 0.0, 0.0]
    ahead = up = 0.0
    # seen from the CoM the right propeller sits at −(L − e) along "left", the left one at L + e
    for size, tilt, arm in zip(thrust, s[10:12], (-(n["L"] - e), n["L"] + e), strict=True):
        pull = (size * math.sin(tilt), 0.0, size * math.cos(tilt))
        moment = [a + b for a, b in zip(moment, cross((0.0, arm, 0.0), pull), strict=True)]
        ahead, up = ahead + pull[0], up + pull[2]
    yaw = moment[2]
    roll = -moment[0] - n["k_t"] * phi - n["d_t"] * roll_rate  # a turn about "forward" lifts the left side

    speed = math.hypot(vx, vy)
    drag = n["c"]  # everything that opposes the velocity, per metre a second
    if speed > 0.0:
        grip = math.tanh(speed / 0.01) / speed
        if "coulomb_friction" in fx:
            drag += fx["coulomb_friction"]["force"] * grip
        if "stribeck_friction" in fx:
            f = fx["stribeck_friction"]
            share = math.exp(-((speed / f["speed"]) ** 2))
            drag += (f["force"] * (1.0 - share) + f["static_force"] * share) * grip
        if "quadratic_drag" in fx:
            drag += fx["quadratic_drag"]["coefficient"] * speed
    if "yaw_damping" in fx:
        yaw -= fx["yaw_damping"]["coefficient"] * yaw_rate
    if "yaw_coulomb_friction" in fx:
        yaw -= fx["yaw_coulomb_friction"]["moment"] * math.tanh(yaw_rate / 0.02)
    # right side up leans the lift to the left
    return {
        "forward": ahead - drag * vx, "left": up * math.sin(phi) + drag * vy,
        "yaw": yaw, "roll": roll, "thrust": thrust,
    }  # fmt: skip


def rates(n: Mapping[str, float], fx: Effects, t: float, s: Sequence[float], act: Sequence[float]) -> list[float]:
    """Time derivative of the state in OWN_ORDER while the commands `act` act."""
    psi, vx, left_speed, yaw_rate = s[2], s[6], -s[7], s[8]
    f = forces(n, fx, t, s)
    ahead, left = f["forward"] / n["m"], f["left"] / n["m"]
    cos, sin = math.cos(psi), math.sin(psi)
    if "table_tilt" in fx:
        pull_x, pull_y = (n["g"] * math.sin(fx["table_tilt"][axis]) for axis in ("x", "y"))
        ahead, left = ahead + pull_x * cos + pull_y * sin, left - pull_x * sin + pull_y * cos
    if "coriolis" in fx:
        turning = cross((0.0, 0.0, yaw_rate), (vx, left_speed, 0.0))  # ω × v
        kappa = fx["coriolis"]["gain"]
        ahead, left = ahead - kappa * turning[0], left - kappa * turning[1]
    swing = [0.0, 0.0]
    tilt_rate = [(target - tilt) / n["tau"] for target, tilt in zip(act[2:], s[10:12], strict=True)]
    if "actuator_second_order" in fx:
        w, zeta = fx["actuator_second_order"]["natural_frequency"], fx["actuator_second_order"]["damping_ratio"]
        tilt_rate = list(s[14:16])
        swing = [w * (w * (act[2 + i] - s[10 + i]) - 2.0 * zeta * s[14 + i]) for i in range(2)]
    if "servo_rate_limit" in fx:
        limit = fx["servo_rate_limit"]["rate"]
        tilt_rate = [math.copysign(min(abs(rate), limit), rate) for rate in tilt_rate]
    spin_up = [(static_thrust(n, act[i]) - s[12 + i]) / n["tau"] for i in range(2)]
    return [
        vx * cos - left_speed * sin, vx * sin + left_speed * cos, yaw_rate, s[9], vx, s[7],
        ahead, -left, f["yaw"] / n["Izz"], f["roll"] / n["Ixx"], *tilt_rate, *spin_up, *swing,
    ]  # fmt: skip


def acting_commands(
    commands: Array, hold: float, fx: Effects, start: Mapping[str, float], t0: float
) -> list[tuple[float, float, tuple[float, ...]]]:
    """Pieces (from, to, command at the lag): the hold, then delay, play, offset, dead band."""
    late = fx.get("actuator_delay", {}).get("time", 0.0)
    end = t0 + len(commands) * hold
    waiting = [start.get(f"actuator_delay.{k}", d) for k, d in
               (("duty_right", HOVER), ("duty_left", HOVER), ("tilt_right", 0.0), ("tilt_left", 0.0))]  # fmt: skip
    jumps = [(t0, tuple(waiting)), *((t0 + k * hold + late, tuple(map(float, u))) for k, u in enumerate(commands))]
    samples = [t0 + k * hold for k in range(len(commands) + 1)]
    edges = sorted({round(t, 12) for t in (*samples, *(t for t, _ in jumps)) if t <= end + 1e-12})
    play = [start.get(f"servo_backlash.play_{side}", 0.0) for side in ("right", "left")]
    pieces = []
    for begin, until in itertools.pairwise(edges):
        u = [value for t, value in jumps if t <= begin + 1e-9][-1]
        tilts = list(u[2:])
        if "servo_backlash" in fx:
            half = fx["servo_backlash"]["width"] / 2.0
            play = [min(max(p, a - half), a + half) for p, a in zip(play, tilts, strict=True)]
            tilts = list(play)
        if "tilt_offset" in fx:
            tilts = [tilts[0] + fx["tilt_offset"]["right"], tilts[1] + fx["tilt_offset"]["left"]]
        if "servo_dead_band" in fx:
            w = fx["servo_dead_band"]["width"]
            tilts = [a - math.copysign(w, a) if abs(a) > w else 0.0 for a in tilts]
        pieces.append((begin, until, (*u[:2], *tilts)))
    return pieces


def simulate(
    commands: Array,
    effects: Effects | None = None,
    numbers: Mapping[str, float] | None = None,
    start: Mapping[str, float] | None = None,
    hold: float = HOLD,
    t0: float = 0.0,
) -> dict[str, Array]:
    """Return outputs by name at t0, t0 + hold, …; `commands` (N, 4) is (δ_R, δ_L, α_R, α_L), with a row per hold."""
    n, fx, start = {**NUMBERS, **(numbers or {})}, effects or {}, start or {}
    at_hover = {"thrust_right": static_thrust(n, HOVER), "thrust_left": static_thrust(n, HOVER)}
    swing = {f"swing_{side}": start.get(f"actuator_second_order.tilt_rate_{side}", 0.0) for side in ("right", "left")}
    s: Sequence[float] = [{**at_hover, **swing, **start}.get(name, 0.0) for name in OWN_ORDER]

    def observed(t: float) -> list[float]:
        named = dict(zip(OWN_ORDER, s, strict=True))
        f = forces(n, fx, t, s)
        named |= {"ax": f["forward"] / n["m"], "thrust_right": f["thrust"][0], "thrust_left": f["thrust"][1]}
        named |= {f"tilt_{side}_actual": named[f"tilt_{side}"] for side in ("right", "left")}
        return [named[name] for name in COLUMNS]

    rows, next_sample = [observed(t0)], 1
    for begin, until, act in acting_commands(np.asarray(commands, dtype=float), hold, fx, start, t0):
        solution = solve_ivp(
            lambda t, s, act=act: rates(n, fx, t, s, act),
            (begin, until), s, method="DOP853", rtol=1e-11, atol=1e-12, first_step=(until - begin) / 2,
        )  # fmt: skip
        s = solution.y[:, -1].tolist()
        if abs(until - (t0 + next_sample * hold)) < 1e-9:
            rows.append(observed(until))
            next_sample += 1
    return dict(zip(COLUMNS, np.array(rows).T, strict=True))


def excitation(count: int, seed: int = 1, tilt: float = 0.25, duty: float = 0.35) -> Array:
    """Return commands (count, 4) with several frequencies and jumps in both tilts and both duties."""
    rng = np.random.default_rng(seed)
    t = HOLD * np.arange(count)[:, None]
    waves = sum(np.sin(2 * np.pi * rng.uniform(0.2, 3.0, 4) * t + rng.uniform(0, 2 * np.pi, 4)) for _ in range(3)) / 3
    jumps = np.repeat(rng.uniform(-1, 1, (count // 10 + 1, 4)), 10, axis=0)[:count]
    size = np.array([duty, duty, tilt, tilt])
    return np.array([HOVER, HOVER, 0.0, 0.0]) + size * (0.6 * waves + 0.4 * jumps)


def to_and_fro(count: int) -> Array:
    """Return commands (count, 4) under which both speeds often change sign, to excite dry friction."""
    t = HOLD * np.arange(count)
    both, turn = 0.2 * np.cos(2 * np.pi * 0.7 * t), 0.1 * np.cos(2 * np.pi * 1.3 * t)
    duty = 0.1 * np.sin(2 * np.pi * 0.9 * t)
    return np.column_stack([HOVER + duty, HOVER + 0.5 * duty, both + turn, both - turn])


def flown(
    stepper: Any, commands: Array, start: Mapping[str, float] | None = None, hold: float = HOLD, t0: float = 0.0
) -> dict[str, Array]:
    """Return the result of `simulate` from the stepper under test."""
    moment = stepper.start(t0, start)
    command = stepper.model.start_command()
    rows = [stepper.output(moment.t, moment.state, command)]
    for k, row in enumerate(np.asarray(commands, dtype=float).tolist()):
        command = tuple(row)
        moment = stepper.step(type(moment)(t0 + k * hold, moment.state, moment.memory), command, hold)
        rows.append(stepper.output(moment.t, moment.state, command))
    names = [q.name for q in stepper.model.outputs]
    return dict(zip(names, np.array(rows).T, strict=True))
