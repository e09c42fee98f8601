"""Solvers of model exchange and of loops with known answers, and the matching of names."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.core.errors import SimulationError
from cosim.simulation.workflow import run
from tests.small_exchange import small_fmu

BOTH = pytest.mark.parametrize("solver", ["cvode", "solve_ivp"])


def ran(folder: Path, components: dict[str, Any], step: float, duration: float, **more: Any) -> Any:
    """Run a scenario; return the results."""
    file = folder / "s.yaml"
    file.write_text(json.dumps({"name": "s", "step": step, "duration": duration, "components": components} | more))
    return run(file, folder / "out", report=False, in_process=True, force=True).results


def alone(folder: Path, fmu: Path, step: float, duration: float, **more: Any) -> Any:
    """Run one FMU."""
    return ran(folder, {"b": {"fmu": fmu.name, "interface": "model-exchange", **more}}, step, duration)


@BOTH
@pytest.mark.parametrize(("wish", "end"), [(1, 4.0), (2, 2.0)])
def test_an_answer_to_an_accepted_step_acts_at_this_step(tmp_path: Path, wish: int, end: float, solver: str) -> None:
    """x' = 1, or −1 from the event that is asked for at the first step after t = 1."""
    fmu = small_fmu(
        tmp_path / "asks.fmu", {"x": 0.0}, derive="x[1] = m->calls > 1 ? -1 : 1;",
        completed=f"if (m->t > 1 && !m->calls) {{ m->calls = 1; return {wish}; }}",
        event="if (m->calls) m->calls = 2", needs_steps=True,
    )  # fmt: skip
    results = alone(tmp_path, fmu, 2.0, 4.0, solver=solver, solver_step=0.01)
    assert results.time[-1] == pytest.approx(end if wish == 1 else results.time[-1])
    if wish == 1:
        assert results["b.x"][1:] == pytest.approx([0.0, -2.0], abs=0.03)
    else:
        assert results.time[-1] <= 1.02


def test_a_stiff_system_ends_with_more_steps_and_agrees_with_solve_ivp(tmp_path: Path) -> None:
    fmu = small_fmu(
        tmp_path / "vdp.fmu", {"x": 2.0, "y": 0.0}, derive="x[2] = x[1]; x[3] = 1000 * (1 - x[0] * x[0]) * x[1] - x[0];"
    )
    with pytest.raises(SimulationError, match=r"max_steps.*solver: solve_ivp"):
        alone(tmp_path, fmu, 10.0, 1500.0, tolerance=1e-7)
    ended = alone(tmp_path, fmu, 10.0, 1500.0, tolerance=1e-7, max_steps=3000)
    other = alone(tmp_path, fmu, 10.0, 1500.0, tolerance=1e-7, solver="solve_ivp")
    assert ended["b.x"][-1] == pytest.approx(other["b.x"][-1], abs=1e-3)
    with pytest.raises(SimulationError, match=r"solve_ivp.*max_steps"):
        alone(tmp_path, fmu, 10.0, 1500.0, tolerance=1e-7, solver="solve_ivp", max_steps=3)


def ball(path: Path, level: float = 0.0, e: float = 0.7, rest: float = 0.0, *, resets: bool = True) -> Path:
    """A ball that falls 1 m and bounces with v → −e·v, and rests below a velocity."""
    bounce = f"x[1] *= -{e!r}; {f'x[0] = {level!r};' if resets else ''} changed = 1;"
    stop = f"if (x[1] > -{rest!r}) {{ x[1] = 0; x[0] = {level + 1e-9!r}; m->calls = 1; changed = 1; }} else"
    return small_fmu(
        path, {"h": level + 1.0, "v": 0.0}, derive="x[2] = x[1]; x[3] = m->calls ? 0 : -9.81;", indicators=1,
        indicate=f"z[0] = x[0] - {level!r};", event=f"if (x[0] <= {level!r} && x[1] < 0) {{ {stop} {{ {bounce} }} }}",
    )  # fmt: skip


@BOTH
@pytest.mark.parametrize("tolerance", [1e-5, 1e-9])
@pytest.mark.parametrize(("level", "e", "resets"), [(0.0, 0.7, True), (0.0, 0.5, False), (1.5, 0.8, False)])
def test_bounces_without_end_end_the_run_and_no_ball_falls_through(
    tmp_path: Path, level: float, e: float, resets: bool, tolerance: float, solver: str
) -> None:
    fmu = ball(tmp_path / "ball.fmu", level, e, resets=resets)
    with pytest.raises(SimulationError) as stopped:
        alone(tmp_path, fmu, 0.05, 6.0, tolerance=tolerance, solver=solver)
    rows = np.loadtxt(tmp_path / "out" / "results.csv", delimiter=",", skiprows=1)
    limit = math.sqrt(2 / 9.81) * (1 + e) / (1 - e)
    assert stopped.value.exit_code == 4
    assert rows[-1, 0] == pytest.approx(limit, abs=0.1)
    assert rows[:, 1].min() >= level - 1e-12


@BOTH
def test_many_events_within_a_step_are_no_fault(tmp_path: Path, solver: str) -> None:
    """x' = ±1 by a carrier of 200 Hz: 20 state events in each communication step."""
    fmu = small_fmu(
        tmp_path / "pwm.fmu", {"x": 0.0}, derive="x[1] = m->calls ? 1 : -1;", indicators=1,
        indicate="z[0] = 0.5 - cos(2 * M_PI * 200 * m->t);", event="m->calls = 0.5 > cos(2 * M_PI * 200 * m->t)",
    )  # fmt: skip
    results = alone(tmp_path, fmu, 0.05, 0.1, solver=solver, solver_step=5e-4)
    assert results["b.x"] == pytest.approx([0.0, 0.05 / 3, 0.1 / 3], abs=1e-5)  # high for 2/3 of each period


START_ONLY = (
    "if (m->initializing || !m->calls) {{ m->calls = !m->initializing; x[2] = {k!r} * x[0] + {c!r}; }} x[1] = x[2];"
)


@pytest.mark.parametrize("loops", [None, {}])
@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("gain", [3.0, -3.0, 1.01, 0.5])
def test_a_loop_of_initialization_is_solved(
    tmp_path: Path, gain: float, declared: bool, loops: dict[str, Any] | None
) -> None:
    """a = gain·b + 1, b = a in initialization; both are constant afterwards."""
    for name, k, c in (("a", gain, 1.0), ("b", 1.0, 0.0)):
        small_fmu(
            tmp_path / f"{name}.fmu", {}, ["u", "y", "kept"], inputs=["u"], derive=START_ONLY.format(k=k, c=c),
            dependencies="" if declared else None, at_start="1" if declared else None,
        )  # fmt: skip
    connections = [{"from": "a.y", "to": "b.u"}, {"from": "b.y", "to": "a.u"}]
    more: dict[str, Any] = {} if loops is None else {"loops": loops}
    parts = {name: {"fmu": f"{name}.fmu"} for name in "ab"}
    results = ran(tmp_path, parts, 0.1, 0.2, connections=connections, **more)
    assert results["a.y"][0] == pytest.approx(1 / (1 - gain), rel=1e-7)
