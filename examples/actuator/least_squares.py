"""Least-squares fit of the actuator: `python examples/actuator/least_squares.py LOGS [--refined FOLDER] [--choose]`.

The speed is not measured: pressure and speed at the start of a prediction over 2.5 s are fitted to the readings of the
second before it. The equations are those of actuator.py.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from yardstick import Array, Channel, Parameters, Rig, main

BASE = {"gain": -15.0, "stiffness": 6.0, "damping": 0.6}
# candidates of physics, chosen before any fit, and the starts of their fits
CANDIDATES = {
    "valve_delay.time": 0.1,
    "valve_offset.value": 0.05,
    "dead_band.width": 0.1,
    "asymmetry.ratio": 0.2,
    "flow_limit.coefficient": 0.3,
    "pressure_drop.inverse_supply": 0.1,
    "leakage.rate": 0.2,
    "dry_friction.level": 0.2,
    "line_drag.coefficient": 0.1,
    "load.pressure": 0.2,
}
BOUNDED = [name for name in CANDIDATES if name not in {"valve_offset.value", "asymmetry.ratio", "load.pressure"}]
GIVEN = {**BASE, **dict.fromkeys(CANDIDATES, 0.0)}
CHOSEN = ("asymmetry.ratio", "valve_delay.time", "pressure_drop.inverse_supply", "leakage.rate")  # as --choose prints
VARIANTS = {
    "base": BASE,
    **{f"{n} chosen terms": {**BASE, **{name: CANDIDATES[name] for name in CHOSEN[:n]}} for n in (2, 4)},
}


def derivative(p: Parameters, state: tuple[Array, ...], valve: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return ṗ = g·φ·√(1 + s·p·sign φ) − k·v − l·p and v̇ = p − d·v − F·tanh(v/0.05) − q·|v|·v + P.

    The opening φ is the valve position with offset, dead band, asymmetry and flow limit.
    """
    pressure, speed = state
    opening = valve[0] + p["valve_offset.value"]
    width = p["dead_band.width"]
    opening = opening - np.maximum(-width, np.minimum(opening, width))
    opening = opening + p["asymmetry.ratio"] * np.abs(opening)
    opening = opening / (1.0 + p["flow_limit.coefficient"] * np.abs(opening))
    drop = 1.0 + p["pressure_drop.inverse_supply"] * np.where(opening >= 0.0, pressure, -pressure)
    rise = p["gain"] * opening * np.sqrt(np.maximum(drop, 0.01))
    rise = rise - p["stiffness"] * speed - p["leakage.rate"] * pressure
    total = pressure - p["damping"] * speed - p["dry_friction.level"] * np.tanh(speed / 0.05)
    return rise, total - p["line_drag.coefficient"] * np.abs(speed) * speed + p["load.pressure"]


RIG = Rig(
    derivative,
    states=2,
    inputs=("valve",),
    channels=(Channel("pressure", "1", 1.0),),
    horizon=2.5,
    every=2,
    past=1.0,
    substeps=1,
    interpolated=True,
    delay="valve_delay.time",
    least=dict.fromkeys([*BOUNDED, "stiffness", "damping"], 0.0),
)

if __name__ == "__main__":
    sys.exit(main(__doc__, RIG, GIVEN, VARIANTS, CANDIDATES))
