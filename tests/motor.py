"""A DC motor as a model of one's own, its winding far faster than its shaft, and logs of one with dry friction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.logs import write_log

MODEL = '''"""Winding and shaft of a DC motor."""

from dataclasses import dataclass

from cosim.model import DryFriction, Equations, Model, Namespace, Number, Quantity, Values, parameter, size


@dataclass(frozen=True, kw_only=True)
class Motor(Model):
    """DC motor: winding and shaft."""

    title = "DC motor"
    base_states = (Quantity("current", "A", "winding current"), Quantity("speed", "rad/s", "shaft speed"))
    inputs = (Quantity("voltage", "V", "terminal voltage"),)
    outputs = base_states
    catalogue, places = (
        DryFriction.named("dry_friction", place="shaft", softness=2.0, level=size("N.m", (0, 1), 0.01, "dry torque")),
    ), ("shaft",)
    sensor_variance = {"current": 1e-4, "speed": 1e-2}
    forced = ("current", "speed")
    calibrated = ("resistance", "inertia")

    resistance: float = parameter(1.2, unit="ohm", bounds=(0.1, 10), doc="winding resistance")
    inductance: float = parameter(2.04e-3, unit="H", bounds=(1e-5, 1), doc="winding inductance")
    constant: float = parameter(0.05, unit="V.s/rad", bounds=(1e-3, 1), doc="torque constant")
    inertia: float = parameter(2e-4, unit="kg.m2", bounds=(1e-6, 1), doc="moment of inertia")
    damping: float = parameter(1e-4, unit="N.m.s/rad", bounds=(0, 1), doc="viscous friction")

    def equations(self, m: Namespace) -> Equations:
        """L·di/dt = u − R·i − k·ω, J·dω/dt = k·i − d·ω + torques of the effects."""
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            current, speed = state
            total = at("shaft", self.constant * current - self.damping * speed, speed)
            left = command[0] - self.resistance * current - self.constant * speed
            return left / self.inductance, total / self.inertia

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
'''


def motor_log(
    path: Path,
    seed: int,
    step: float = 0.02,
    seconds: float = 8.0,
    dry: float = 0.01,
    inertia: float = 2e-4,
    inductance: float = 2.04e-3,
) -> Path:
    """Voltage steps every second, solved by LSODA between the rows; noise of 10 mA and 0.1 rad/s."""
    from scipy.integrate import solve_ivp

    rng, rows = np.random.default_rng(seed), round(seconds / step) + 1
    voltage = np.repeat(rng.uniform(-12.0, 12.0, round(seconds) + 1), round(1.0 / step))[:rows]
    state = np.zeros((rows, 2))
    for k in range(rows - 1):

        def rates(t: float, x: np.ndarray, u: float = voltage[k]) -> list[float]:
            current, speed = x
            torque = 0.05 * current - 1e-4 * speed - dry * np.tanh(speed / 2.0)
            return [(u - 1.2 * current - 0.05 * speed) / inductance, torque / inertia]

        state[k + 1] = solve_ivp(rates, (0.0, step), state[k], method="LSODA", rtol=1e-8, atol=1e-10).y[:, -1]
    read = state + rng.standard_normal(state.shape) * [0.01, 0.1]
    time = step * np.arange(rows)
    return write_log(path, {"time": time, "voltage": voltage, "current": read[:, 0], "speed": read[:, 1]})


def motor_file(folder: Path, stated: str = "", inductance: str = "2.04e-3", integrator: str = "") -> Path:
    """Write motor.py with another inductance [H], and with a substep and an integrator if given; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    text = MODEL.replace("parameter(2.04e-3", f"parameter({inductance}")
    line = '    calibrated = ("resistance", "inertia")\n'
    more = f"    substep = {stated}\n" if stated else ""
    more += f'    integrator = "{integrator}"\n' if integrator else ""
    (folder / "motor.py").write_text(text.replace(line, line + more))
    return folder / "motor.py"
