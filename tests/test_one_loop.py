"""Random systems have the same rows whatever steps them: C, Python, or the policy of events."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest

import cosim
from cosim.core.arrays import Array
from tests.random_systems import build_fmus, random_system, with_component, write

EVENTS = {"fmu": "clocked.fmu"}  # has event mode, so that all are stepped from event to event


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("fmus")
    build_fmus(place)
    return place


def rows(folder: Path, system: dict[str, Any], loop: str, columns: Sequence[str] = ()) -> tuple[Sequence[str], Array]:
    """Return columns and rows of a run, after a check of what stepped it."""
    path = write(system, folder / "system.json")
    results = cosim.run(path, out=folder / "out", report=False, in_process=True, force=True).results
    assert results.loop.startswith(loop)
    columns = columns or results.columns
    return columns, results.values[:, [results.columns.index(name) for name in columns]]


@pytest.mark.parametrize("seed", range(16))
def test_c_and_python_give_the_same_bytes_and_events_the_same_numbers(folder: Path, seed: int) -> None:
    system = random_system(Random(seed))
    columns, in_c = rows(folder, system, "C")
    _, in_python = rows(folder, with_component(system, fmu="text.fmu"), "Python: aside.mood", columns)
    assert in_python.tobytes() == in_c.tobytes()
    _, at_events = rows(folder, with_component(system, **EVENTS), "Python: event mode", columns)
    assert at_events == pytest.approx(in_c, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("seed", range(16, 24))
def test_blocks_that_only_python_steps_and_loops_have_the_same_numbers_from_event_to_event(
    folder: Path, seed: int
) -> None:
    random = Random(seed)
    system = random_system(random) | {"algorithm": "gauss-seidel"}
    system["components"] |= {
        "fix": {"block": "fix", "rate": 12, "latency": 0.02, "signals": {"y": {"noise": {"variance": 0.1}}}},
        "a": {"fmu": "linear.fmu", "start": {"p0": random.uniform(-2, 0.5), "p1": 1.0}},
        "b": {"fmu": "linear.fmu", "start": {"p0": random.uniform(-2, 0.5)}},
    }
    system["connections"] += [
        {"from": "c0.y", "to": "fix.y"},
        {"from": "a.y0", "to": "b.u0"},
        {"from": "b.y0", "to": "a.u0"},
    ]
    columns, equal = rows(folder, system, "Python: algebraic loops")
    _, at_events = rows(folder, with_component(system, **EVENTS), "Python: event mode", columns)
    assert at_events == pytest.approx(equal, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("seed", range(24, 30))
def test_controlled_steps_of_the_length_of_equal_ones_have_the_same_numbers(folder: Path, seed: int) -> None:
    system = random_system(Random(seed))
    for component in system["components"].values():
        component.pop("step", None)
    step = {"max": 0.01, "min": 0.01, "rows": 0.01, "tolerance": 1.0, "estimator": "residual"}
    for extrapolate in ("hold", "linear", "quadratic"):
        for interpolate in ("hold", "linear"):
            alike = system | {"extrapolate": extrapolate, "interpolate": interpolate}
            columns, equal = rows(folder, alike, "")
            _, controlled = rows(folder, alike | {"step": step}, "Python: steps are controlled", columns)
            assert controlled == pytest.approx(equal, rel=1e-12, abs=1e-12), (extrapolate, interpolate)
