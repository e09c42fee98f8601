"""Terms in hand-written C, FMUs to add them to, and simulations of both in FMPy."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import fmpy
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.fmi.building.build import build_native
from cosim.fmi.native.compiler import compiler
from cosim.model.quantities import Parameter
from cosim.terms.code import HOOKS, Hook, TermCode
from tests.conftest import ROOT
from tests.slider import slider_fmu

Array = NDArray[np.float64]
EXCHANGE, STEPS = "ModelExchange", "CoSimulation"
WAYS = (EXCHANGE, STEPS)
STEP = 0.01  # communication step [s]
SMOOTH = 1e-3  # speed [m/s] below which dry friction is smoothed, as in the drive

SIGNATURE = {
    "shape_all": "double t, const double *u, const double *m, const double *p, double *out",
    "port_inputs": "double t, const double *x, const double *u, const double *p, double *out",
    "added_rates": "double t, const double *x, const double *u, const double *p, double *out",
    "readings": "double t, const double *y, const double *p, double *out",
}
# Each term: parameters with units, and the C lines of its functions for the variables force, position, velocity.
TERMS: dict[str, tuple[dict[str, str], dict[Hook, str]]] = {
    "bias": ({"bias_at_force.offset": "N"}, {"shape_all": "out[0] = u[0] + p[0];"}),
    "dead_band": (
        {"dead_band_at_force.half_width": "N"},
        {"shape_all": "out[0] = fabs(u[0]) <= p[0] ? 0.0 : u[0] - copysign(p[0], u[0]);"},
    ),
    "lag": (
        {"lag_at_force.time": "s"},
        {
            "shape_all": "const double start = m[1] ? m[0] : u[0];"
            "out[0] = p[0] > 0 ? u[0] + (start - u[0]) * exp(-p[1] / p[0]) : u[0]; out[1] = out[0]; out[2] = 1.0;"
        },
    ),
    "coulomb": (
        {"coulomb_at_velocity.level": "N"},
        {"port_inputs": f"out[0] = u[0] - p[0] * tanh(x[1] / {SMOOTH});"},
    ),
    "rate": (
        {"viscous_at_velocity.coefficient": "1/s"},
        {"added_rates": "out[0] = 0.0; out[1] = -p[0] * x[1];"},
    ),
    "sensor": (
        {"bias_at_position.offset": "m"},
        {"readings": "out[0] = y[0] + p[0]; out[1] = y[1];"},
    ),
    "delay": ({"delay.time": "s"}, {}),
    "all": (
        {"idle_at_force.level": "N"},
        {
            "shape_all": "out[0] = u[0]; out[1] = m[0];",
            "port_inputs": "out[0] = u[0];",
            "added_rates": "out[0] = out[1] = 0.0;",
            "readings": "out[0] = y[0]; out[1] = y[1];",
        },
    ),
}


def function(hook: str, lines: str) -> str:
    """Return a function of C."""
    return f"static void {hook}({SIGNATURE[hook]})\n{{\n    {lines}\n}}\n"


def terms_of(kind: str, states: Sequence[str] = ("position", "velocity")) -> TermCode:
    """Return the terms of a kind. The term "all" changes nothing."""
    parameters, bodies = TERMS[kind]
    return TermCode(
        source="\n".join(function(hook, lines) for hook, lines in bodies.items()),
        parameters=tuple(Parameter(n, 0.0, unit, f"parameter {n}", neutral=0.0) for n, unit in parameters.items()),
        inputs=("force",),
        states=tuple(states),
        outputs=("position", "velocity"),
        memory={"lag": 2, "all": 1}.get(kind, 0),
        hooks=tuple(hook for hook in HOOKS if hook in bodies),
        delay="delay.time" if kind == "delay" else "",
    )


@cache
def drive_fmu(fmi: int) -> Path:
    """Return the native FMU of the example drive, compiled once: model exchange and co-simulation."""
    if compiler() is None:
        pytest.skip("no C compiler")
    (built,) = build_native(
        Path(mkdtemp(prefix="drive-")), f"{ROOT / 'examples' / 'drive' / 'drive.py'}:Drive", fmi=fmi
    )
    return built.path


def fmu_of(name: str, fmi: int, way: str, folder: Path) -> Path:
    """Return an original: the drive, which has both interfaces, or the slider of one interface."""
    if name == "drive":
        return Path(shutil.copy(drive_fmu(fmi), folder / "drive.fmu"))
    return slider_fmu(folder / "slider.fmu", fmi, exchange=way == EXCHANGE)


def states_of(name: str) -> tuple[str, ...]:
    """Return the names of the states."""
    return ("position_state", "velocity_state") if name == "drive" else ("position", "velocity")


def push(seconds: float = 4.0, size: float = 60.0) -> Array:
    """Return time and a force that jumps every 0.5 s and stays in between: rows of a table, two at a jump."""
    rng = np.random.default_rng(3)
    values = size * rng.uniform(-1.0, 1.0, round(seconds / 0.5))
    times = 0.5 * np.arange(values.size + 1)
    rows = [(t, f) for k, f in enumerate(values) for t in (times[k], times[k + 1])]
    return np.array(rows)


def simulated(
    fmu: Path, way: str, force: Array, start: Mapping[str, Any] | None = None, tolerance: float = 1e-9
) -> Array:
    """Return time, position and velocity at every communication step, by FMPy."""
    rows = np.array([tuple(row) for row in force], dtype=[("time", float), ("force", float)])
    found = fmpy.simulate_fmu(
        str(fmu), validate=False, fmi_type=way, start_values=dict(start or {}), input=rows, stop_time=force[-1, 0],
        output_interval=STEP, relative_tolerance=tolerance, record_events=False, output=["position", "velocity"],
    )  # fmt: skip
    return np.column_stack([found[n] for n in ("time", "position", "velocity")])


def exact(force: Array, delay: float = 0.0, lag: float = 0.0, mass: float = 95.0, viscous: float = 200.0) -> Array:
    """Return what the drive does with a late or lagging force, by the exponential of its matrix."""
    rates = np.zeros((4, 4))  # of position, velocity, the force that acts, and the one commanded
    rates[0, 1], rates[1, 1], rates[1, 2 if lag else 3] = 1.0, -viscous / mass, 1.0 / mass
    if lag:
        rates[2, 2:] = -1.0 / lag, 1.0 / lag
    h = STEP / 2
    forward, z, rows = expm(rates * h), np.array([0.0, 0.0, force[0, 1], 0.0]), [(0.0, 0.0, 0.0)]
    for k in range(round(force[-1, 0] / h)):
        z[3] = force[max(0, np.searchsorted(force[:, 0], (k + 0.5) * h - delay)), 1]
        z = forward @ z
        if k % 2:
            rows.append(((k + 1) * h, z[0], z[1]))
    return np.array(rows)


def off(a: Array, b: Array) -> float:
    """Return the largest difference of positions and velocities."""
    assert len(a) == len(b)
    return float(np.abs(a - b)[:, 1:].max())
