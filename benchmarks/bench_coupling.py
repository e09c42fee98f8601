"""Benchmarks of coupling: Newton iterations of an algebraic loop, and points of controlled and of equal steps."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.files.results import Results
from cosim.fmi.native.compiler import compiler
from cosim.master.master import simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from examples.coupling.build import HERE, build_all

FIGURES = ("newton_iterations", "controlled_over_fixed", "controlled_over_fixed_linear", "residual_over_fixed_linear")
ROW, SECONDS = 0.02, 5.0
PARTS = 16, 64  # steps of equal length in a row, between which the error is interpolated
LINEAR = "extrapolate=linear", "interpolate=linear"
BY_RESIDUAL = "step.estimator=residual", "step.tolerance=1e-3", "step.max=0.004", f"step.rows={ROW}"
Array = NDArray[np.float64]


def coupling_figures(place: Path) -> dict[str, float | str]:
    """Return each figure by name, or the reason for a missing one."""
    if compiler() is None:
        return dict.fromkeys(FIGURES, "no C compiler")
    build_all(place)
    for name in ("truck", "power"):
        (place / f"{name}.yaml").write_text((HERE / f"{name}.yaml").read_text())
    loop = results(place / "power.yaml").details["loops"][0]
    exact = exact_truck()
    controlled = results(place / "truck.yaml")
    by_residual = results(place / "truck.yaml", BY_RESIDUAL)

    def over_fixed(run: Results, overrides: tuple[str, ...] = ()) -> float:
        points = points_of_equal_steps(place / "truck.yaml", error_of(run, exact), exact, overrides)
        return float(run.details["steps"]["communication_points"] / points)

    return {
        "newton_iterations": loop["iterations"]["total"] / loop["points"],
        "controlled_over_fixed": over_fixed(controlled),
        "controlled_over_fixed_linear": over_fixed(controlled, LINEAR),
        "residual_over_fixed_linear": over_fixed(by_residual, LINEAR),
    }


def results(scenario: Path, overrides: tuple[str, ...] = ()) -> Results:
    """Return the results of a scenario."""
    file = ScenarioFile(scenario, overrides)
    return simulate(build_system(file), file.scenario.steps, file.scenario.step)


def points_of_equal_steps(scenario: Path, error: float, exact: Array, overrides: tuple[str, ...] = ()) -> float:
    """Return the number of equal steps with an error.

    A power law through two runs gives it.
    """
    errors = []
    for parts in PARTS:
        run = results(scenario, (f"step={ROW / parts!r}", *overrides))
        errors.append(error_of(run, exact, parts))
    order = math.log(errors[0] / errors[1]) / math.log(PARTS[1] / PARTS[0])
    return float(SECONDS / ROW * PARTS[0] * (errors[0] / error) ** (1.0 / order))


def error_of(run: Results, exact: Array, parts: int = 1) -> float:
    """Return the largest relative error of all outputs."""
    names = ("chassis.velocity", "chassis.height", "wheel.force", "wheel.height")
    values = np.array([run[name] for name in names]).T[::parts]
    return float(np.max(np.abs(values - exact) / np.abs(exact).max(axis=0)))


def exact_truck() -> Array:
    """Return the exact outputs of the truck at its rows."""
    from scipy.integrate import solve_ivp

    from examples.coupling.chassis import Chassis
    from examples.coupling.wheel import Wheel

    chassis, wheel = Chassis(), Wheel()

    def force(s: Any) -> Any:
        return wheel.spring * (s[3] - s[1]) + wheel.damper * (s[2] - s[0])

    def rates(t: float, s: Any) -> list[float]:
        share = (t - wheel.bump_start) / wheel.bump_length
        road = 0.5 * wheel.bump_height * (1.0 - math.cos(2.0 * math.pi * share)) if 0.0 <= share <= 1.0 else 0.0
        return [force(s) / chassis.mass, s[0], (wheel.tyre * (road - s[3]) - force(s)) / wheel.mass, s[2]]

    times = ROW * np.arange(round(SECONDS / ROW) + 1)
    s = solve_ivp(rates, (0.0, SECONDS), np.zeros(4), "DOP853", times, rtol=1e-11, atol=1e-13, max_step=1e-3).y
    return np.array([s[0], s[1], force(s), s[3]]).T
