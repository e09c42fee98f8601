"""Gains judged on the craft that flies, its lag on both axes, the sample, the filter; held against flights."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.designer import DESIGNER
from controller.gains import ESTIMATORS, Settings
from controller.laws import IntegralFeedback, StateFeedback
from controller.placement import POLES, placed_gain
from controller.stability import MIN_DAMPING, FlownLoop, LoopMode, swing_ratio, worst_modes
from controller.synthesis import integral_gain, lqr_gain
from controller.variants import GAINS, INTEGRALS, FullSettings, integral_settings, mirrored
from cosim.base.errors import InputError
from cosim.fmi.fmu_build import build
from cosim.scenario.controller_design import designed_values
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from fmus.recipes import poles_recipe
from tests.controllers import LAWS, STEP, fly, swings

BY_POLES = ["components.controller.fmu=../build/controller-pole.fmu"]
FAST = (-2.0, -4.0, -11.0, -15.0, -16.0)  # stable on eqs 5.33/5.34, not where the turn lags


def slowest(K: Any, K_i: Any = None, *, axis: str, estimator: str = "appendix_f") -> LoopMode:
    p = FullSettings(estimator=estimator)
    return next(mode for mode in FlownLoop(p, p).modes(K, K_i) if mode.axis == axis and mode.pole.imag >= 0)


def flown_poles(K: Any, start: str, size: float, until: float, K_i: Any = None, **settings: Any) -> list[complex]:
    """Poles [rad/s] of a pair, out of the last half second of a flight: αₖ₊₂ = a·αₖ₊₁ + b·αₖ of a tilt."""
    kind: Any = Settings() if K_i is None else integral_settings()
    gains = dict(zip(GAINS, K.ravel(), strict=True))
    if K_i is not None:
        gains |= dict(zip(INTEGRALS, K_i.ravel(), strict=True))
    law: Any = StateFeedback if K_i is None else IntegralFeedback
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LAWS, "mine", (replace(kind, **gains, **settings), law))
        tilt = fly("mine", duration=until, start={start: size}).command[-25:, 2]
    a, b = np.linalg.lstsq(np.column_stack([tilt[1:-1], tilt[:-2]]), tilt[2:], rcond=None)[0]
    return [cmath.log(z) / STEP for z in np.roots([1, -a, -b])]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("turn", [(-10.0, -12.0), FAST[3:]])
def test_the_turn_swings_in_a_flight_as_its_pole_says(turn: tuple[float, ...], estimator: str) -> None:
    K = placed_gain(Settings(), (*POLES[:3], *turn))
    expected = slowest(K, axis="turning", estimator=estimator).pole
    found = flown_poles(K, "psi", 1e-4, 4.0, estimator=estimator)
    # 1e-3: the filter's gain is steady after a second, the equations are nonlinear by 1e-8 of it
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_the_forward_axis_grows_in_a_flight_as_its_pole_says_and_integrals_count() -> None:
    K = placed_gain(Settings(), (-20.0, -21.0, -22.0, -4.0, -5.0))
    expected = slowest(K, axis="forward").pole
    assert expected.imag == pytest.approx(math.pi / STEP)  # from sample to sample
    found = flown_poles(K, "x", 1e-21, 0.6)
    assert min(abs(s.real - expected.real) for s in found) < 1e-3 * expected.real
    K, K_i = integral_gain(Settings(), (10.0, 0.5, 10.0, 0.01, 0.0), Q_integral=(1.0, 400.0))
    expected = slowest(K, K_i, axis="turning").pole
    assert expected.real > 0
    assert slowest(K, axis="turning").pole.real < expected.real - 0.1  # without its integrals
    found = flown_poles(K, "psi", 1e-5, 3.0, K_i)
    assert min(abs(s - expected) for s in found) < 1e-3 * abs(expected)


def test_all_designs_of_the_thesis_and_ours_are_damped_as_printed_with_every_estimator() -> None:
    """docs/controllers.md."""
    found = {e: [(name, f"{m.pole:.1f}", f"{m.damping:.2f}") for name, m in of.items()] for e, of in swings().items()}
    text = (Path(__file__).resolve().parent.parent / "docs" / "controllers.md").read_text(encoding="utf-8")
    for estimator, laws in found.items():
        told = "   ".join(f"{name} {pole.replace('+', '±')} {damping}" for name, pole, damping in laws)
        assert f"{estimator:12}{told}" in text
    for estimator in ESTIMATORS:
        p = FullSettings(estimator=estimator)
        loop = FlownLoop(p, p)
        every = [*loop.modes(lqr_gain(p)), *loop.modes(placed_gain(p)), *loop.modes(*integral_gain(p))]
        assert worst_modes(every) == []
        assert min(mode.damping for mode in every) > 0.29


def test_a_craft_without_friction_drifts_but_does_not_grow() -> None:
    p = FullSettings(friction=0.0)  # its speed is in no measurement: a pole at 0 that no gain moves
    assert worst_modes(FlownLoop(p, p).modes(lqr_gain(p))) == []


def test_a_swing_damped_by_a_tenth_keeps_half_of_its_size() -> None:
    assert swing_ratio(MIN_DAMPING) == pytest.approx(0.53, abs=0.005)


@pytest.fixture
def flown(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    build(poles_recipe(), project / "build" / "controller-pole.fmu")
    monkeypatch.chdir(project / "scenarios")
    return project


def scenario(design: str, start: str = "{x_hat_start: 1, psi_hat_start: 1, tilt_max: 12 deg}") -> Path:
    text = Path("regulate.yaml").read_text(encoding="utf-8")
    first, last = text.index("design:"), text.index("components:")
    text = f"{text[:first]}design:\n  {design}\n{text[last:]}"
    Path("mine.yaml").write_text(
        text.replace("{x_hat_start: 1, psi_hat_start: 1, tilt_max: 12 deg}", start), encoding="utf-8"
    )
    return Path("mine.yaml")


def test_poles_that_do_not_fly_are_refused_at_the_fastest_of_them_with_others_that_do(flown: Path) -> None:
    with pytest.raises(InputError) as refusal:
        run(scenario("poles: [-2, -4, -11, -15, -16]"), flown / "out", BY_POLES, report=False)
    (fault,) = refusal.value.faults
    assert (fault.line, fault.column) == (10, 29)  # of -16
    assert "the turning axis has a pole at 0.193±15.6j rad/s; take slower poles there, -9, -9.6" in fault.message
    assert not (flown / "out").exists()
    cured = ScenarioFile(scenario("poles: [-2, -4, -11, -9, -9.6]"), BY_POLES)
    assert designed_values(cured)
    assert cured.warnings == []


def test_poles_that_hardly_damp_are_a_warning_of_the_run(flown: Path) -> None:
    outcome = run(
        scenario("poles: [-2, -4, -11, -10, -12]"), flown / "out", [*BY_POLES, "duration=1", "criteria={}"],
        in_process=True,
    )  # fmt: skip
    (told,) = [w for w in outcome.manifest["warnings"] if w.startswith("design.poles")]
    assert "hardly damped by 0.073: a swing keeps 63 % of its size" in told
    assert "hardly damped by 0.073" in (flown / "out" / "report.html").read_text(encoding="utf-8")


def test_weights_that_do_not_fly_are_refused_and_those_proposed_do(flown: Path) -> None:
    file = ScenarioFile(scenario("Q: [1000, 500, 100, 10, 0]"))
    assert designed_values(file) == {}
    assert [(f.line, "R: [" in f.message) for f in file.faults] == [(10, True)] * 2
    R = [100, 100]
    assert "forward axis" in file.faults[0].message
    assert f"R: {R} for one" in file.faults[0].message
    cured = ScenarioFile(scenario(f"{{Q: [1000, 500, 100, 10, 0], R: {R}}}"))
    assert designed_values(cured)
    assert cured.warnings == []


def test_gains_of_the_scenarios_own_are_judged_where_they_stand(flown: Path) -> None:
    file = ScenarioFile(scenario("R: [1, 1]", "{k_1_3: 3.5, k_2_3: -3.5}"))
    assert designed_values(file) == {}
    (fault,) = file.faults
    place = file.path.read_text(encoding="utf-8").splitlines()[fault.line - 1][fault.column - 1 :]
    assert place.startswith("3.5, k_2_3")
    assert "is not stable as it flies" in fault.message


def test_a_longer_sample_makes_a_loop_unstable(flown: Path) -> None:
    slow = {"sample_time": 0.3}
    gains = mirrored(placed_gain(Settings(), POLES)[0].tolist())
    judged = DESIGNER.judged(gains, slow, {"poles": POLES}, "poles")
    assert any("a sample of 0.3 s" in o.message for o in judged.objections)
    assert DESIGNER.judged(gains, {}, {"poles": POLES}, "poles") == ([], [])
