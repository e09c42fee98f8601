"""Terms without a name: of a block whose rail, clock or law of friction hides something, and inside a stepped FMU."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.arrays import Array
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import read_log
from cosim.model import Equations, Model, Namespace, Quantity, parameter
from cosim.refinement.search.fits import Search
from cosim.refinement.search.unnamed import Leftover, find_unnamed_terms
from tests import pendulums
from tests.logs import write_log

STEP, ROWS, NOISE = 0.02, 900, 5e-4
UNITS = {"time": "s", "place": "m", "speed": "m/s", "command force": "N"}
Push = Callable[[float, float, float], float]


@dataclass(frozen=True, kw_only=True)
class Block(Model):
    """A block on a rail, held by a spring, its place measured."""

    base_states = (Quantity("place", "m", "place"), Quantity("speed", "m/s", "speed"))
    inputs, outputs = (Quantity("force", "N", "force"),), base_states[:1]
    sensor_variance, forced, calibrated = {"place": NOISE**2}, ("speed",), ("friction",)
    scale = 1.0  # of a place in another unit than metres
    friction: float = parameter(0.8, unit="N.s/m", bounds=(0, 10), doc="viscous friction")

    def equations(self, m: Namespace) -> Equations:
        """v̇ = u − b·v − 2·x."""
        return Equations(
            lambda t, x, u: (x[1], self.scale * u[0] - self.friction * x[1] - 2.0 * x[0]), lambda t, x, u: (x[0],)
        )


@dataclass(frozen=True, kw_only=True)
class Fine(Block):
    """The same in millimetres."""

    scale, sensor_variance = 1e3, {"place": (1e3 * NOISE) ** 2}


def left(folder: Path, push: Push, shown: Callable[[Array], Array] = np.array, block: Model = Block()) -> Leftover:
    """What is left beside the block recalibrated, on two logs of a block with another push on it, or another sensor."""
    logs = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        time = STEP * np.arange(ROWS)
        force = np.repeat(rng.uniform(-2.0, 2.0, ROWS // 30 + 1), 30)[:ROWS]
        x, v, places = 0.0, 0.0, []
        for t, u in zip(time, force, strict=True):
            places.append(x)
            for k in range(4):
                v += STEP / 4 * (u - 0.8 * v - 2.0 * x + push(t + k * STEP / 4, x, v))
                x += STEP / 4 * v
        place = shown(np.array(places) + NOISE * rng.standard_normal(ROWS))
        path = write_log(folder / f"{seed}.csv", {"time": time, "force": force, "place": place})
        logs.append(read_log(path, Block.inputs, Block.outputs))
    problem = build_problem(ModelSubject.of(block), logs, unnamed=True)
    at = Search(ModelSubject.of(block), problem, 1, lambda stage, share: None).hypothesis((), None).fit
    return find_unnamed_terms(replace(problem, sensing=at.noise), at, UNITS)


@pytest.mark.thorough
def test_a_tight_place_on_the_rail_is_found_where_it_is(tmp_path: Path) -> None:
    place, half = 0.3, 0.12
    found = left(tmp_path, lambda t, x, v: -2.0 * v * np.exp(-(((x - place) / half) ** 2)))
    first = found.terms[0]
    assert first.shape is not None
    assert (first.equation, first.shape.kind, first.shape.of) == ("speed", "bump", ("place",))
    assert abs(first.shape.place - place) < first.shape.width
    assert first.shape.width < 0.6  # of 2 m that it moves over
    assert first.coefficient < 0.0
    assert "speed" in first.shape.factor
    assert found.is_placed


@pytest.mark.thorough
def test_a_law_that_holds_everywhere_is_not_told_as_local_and_where_nothing_is_hidden_is_none(tmp_path: Path) -> None:
    first = left(tmp_path, lambda t, x, v: -0.3 * v**3).terms[0]
    assert first.shape is None
    assert first.signal in {"speed³", "speed·|speed|"}
    assert left(tmp_path, lambda t, x, v: 0.0).terms == ()


@pytest.mark.thorough
def test_what_an_unnamed_term_takes_away_does_not_depend_on_the_unit(tmp_path: Path) -> None:
    """Quadratic drag, the place in metres and in millimetres."""
    push: Push = lambda t, x, v: -0.3 * abs(v) * v  # noqa: E731
    here, there = (left(tmp_path, push).terms[0], left(tmp_path, push, lambda x: 1e3 * x, Fine()).terms[0])
    assert (here.equation, here.signal) == (there.equation, there.signal)
    assert here.share is not None
    assert here.share > 0.8
    # the range of the process noise is interpolated on a grid of ln q, on which the two lie differently
    assert there.share == pytest.approx(here.share, abs=2e-3)


@pytest.mark.parametrize(
    ("push", "shown", "expected", "place", "period"),
    [
        pytest.param(
            lambda t, x, v: 0.15 if t > 10.0 else 0.0, np.array, ("speed", "step", "time"), 10.0, None,
            marks=pytest.mark.thorough,
        ),
        (lambda t, x, v: 0.02 * np.sin(8.0 * t + 1.0), np.array, ("speed", "wave", "time"), None, 2.0 * np.pi / 8.0),
        (lambda t, x, v: 0.0, lambda x: x + 2e-3 * np.sin(30.0 * x), ("reading of place", "wave", "place"), None,
         2.0 * np.pi / 30.0),
    ],
    ids=["step", "push", "sensor"],
)  # fmt: skip
def test_what_begins_or_repeats_is_found_where_it_acts(
    tmp_path: Path,
    push: Push,
    shown: Callable[[Array], Array],
    expected: tuple[str, str, str],
    place: float | None,
    period: float | None,
) -> None:
    first = left(tmp_path, push, shown).terms[0]
    assert first.shape is not None
    assert (first.equation, first.shape.kind, first.signal) == expected
    assert place is None or first.shape.place == pytest.approx(place, abs=first.shape.width)
    assert period is None or first.shape.width == pytest.approx(period, rel=0.05)


BESIDE = "ambiguous: a square law at the torque beside it, 58 %"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("case", "verdict", "signals"),
    [
        ("gap", "unexplained", ["phi1 − phi2"]),
        ("dry_hinge", "unexplained", ["rate of phi1"]),
        pytest.param("stiffness", "parameter_error", [], marks=pytest.mark.xfail(strict=True, reason=BESIDE)),
        ("nothing", "no_effect", []),
    ],
)
def test_an_effect_inside_a_stepped_fmu_is_no_wrong_parameter(
    tmp_path: Path, case: str, verdict: str, signals: list[str]
) -> None:
    pendulums.write(tmp_path, case, 2, "co_simulation")
    found = cosim.refine(tmp_path / "study.yaml", out=tmp_path / "refined", report=False)
    answer = json.loads((tmp_path / "refined" / "refine.json").read_text(encoding="utf-8"))
    assert found.verdict == answer["verdict"] == verdict
    assert answer["residual"]["signals"] == signals
    assert answer["untested"]  # co-simulation gives no access to the inside
