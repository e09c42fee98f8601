"""`cosim linearize`: the thesis' matrices (5.17-5.19, App. E) of the one body, unlike systems, FMUs, bad input."""

from __future__ import annotations

import json
import math
import runpy
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import scipy.io

from controller.design_model import design_model, measurement_matrix
from controller.settings import Settings
from cosim.core.errors import InputError
from cosim.linearization.linear_model import Linear, Point, structure
from cosim.linearization.workflow import linearize
from cosim.linearization.write import headline
from tests.conftest import ROOT
from tests.tank import MODEL

SCHEMA = ROOT / "docs" / "schemas" / "linear_result.schema.json"
EIGHT = ("x", "vx", "y", "vy", "psi", "psi_dot", "phi", "phi_dot")  # eq 5.11
FOUR = ("duty_right", "duty_left", "tilt_right", "tilt_left")
LAGS = ("thrust_right", "thrust_left", "tilt_right", "tilt_left")
# friction, roll support and the ground effect of each height are not in eq 5.14
BARE = ("friction=0", "table_roll_stiffness=0", "table_roll_damping=0", "roll_ground_effect=false")


def eight(**at: float) -> Linear:
    """A(t), B(t) of the plant with the lag residualised, by the verb's own function."""
    values = [f"{name}={value!r}" for name, value in at.items()]
    return linearize("base", at=values, set=BARE, states=EIGHT, inputs=FOUR, residualize=LAGS, outputs=["psi"]).first


def printed(phi: float, duties: tuple[float, float], tilts: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Eqs 5.18 and 5.19 as they stand, written down from the page; Γ by eq 4.28 with its minus sign."""
    m, L, Izz, Ixx, g = 0.705, 0.17145, 0.01023, 0.009377, 9.81e-3
    gamma = 1.0 / (1.0 - (0.127 / (4.0 * 0.095)) ** 1.902)
    TR, TL = ((-2076.0 + 359.9 * d) * g for d in duties)  # 5.15
    dT = 359.9 * g  # 5.16
    (cR, sR), (cL, sL) = ((math.cos(a), math.sin(a)) for a in tilts)
    A, B = np.zeros((8, 8)), np.zeros((8, 4))
    A[0, 1] = A[2, 3] = A[4, 5] = A[6, 7] = 1.0
    A[3, 6] = -gamma / m * (cR * TR + cL * TL)
    B[1] = gamma / m * np.array([sR * dT, sL * dT, cR * TR, cL * TL])
    B[3] = gamma / m * phi * np.array([-cR * dT, -cL * dT, sR * TR, sL * TL])
    B[5] = gamma * L / Izz * np.array([sR * dT, -sL * dT, cR * TR, -cL * TL])
    B[7] = gamma * L / Ixx * np.array([cR * dT, -cL * dT, -sR * TR, sL * TL])
    return A, B


@pytest.mark.parametrize("phi", [0.0, 0.02, -0.1])
def test_the_time_variant_matrices_of_eqs_5_18_and_5_19_are_the_plant_s(phi: float) -> None:
    found = eight(phi=phi, duty_right=6.5, duty_left=6.2, tilt_right=0.2, tilt_left=-0.1)
    A, B = printed(phi, (6.5, 6.2), (0.2, -0.1))
    assert found.states == EIGHT
    # eq 5.14 writes φ for sin φ: cos φ stands in A's one entry, sin φ in B's fourth row; all else is the same
    A[3, 6] *= math.cos(phi)
    B[3] *= math.sin(phi) / phi if phi else 1.0
    assert np.abs(found.A - A).max() < 1e-12
    assert np.abs(found.B - B).max() < 1e-12


def test_the_numbers_of_eqs_e1_and_e2_with_the_corrections() -> None:
    found = eight(tilt_right=0.2, tilt_left=0.2)
    B, slope = found.B, 359.9 * 9.81e-3
    thrust = (-2076.0 + 359.9 * 6.38763) * 9.81e-3  # without ground effect, T_R(u₁)
    sin, cos = math.sin(0.2), math.cos(0.2)
    assert found.A[3, 6] / (-2 * cos * thrust) == pytest.approx(1.620, abs=5e-4)
    column = B[[1, 5, 7], 0] / (np.array([sin, sin, cos]) * slope)
    assert (np.abs(column - [1.620, 19.14, 20.881]) < [5e-4, 5e-3, 5e-4]).all()  # E.2 prints 20.90
    # E.2 prints sin in the tilts' columns of rows 2 and 6, cos in row 8; 5.19 and the differentiation have them so:
    column = B[[1, 5, 7], 2] / (np.array([cos, cos, -sin]) * thrust)
    assert (np.abs(column - [1.620, 19.14, 20.881]) < [5e-4, 5e-3, 5e-4]).all()


def test_the_eight_states_are_three_chains_of_integrators() -> None:
    # φ̈ → φ → v̇y → y is a chain of four, x and ψ are double integrators; every one of them is steered
    linear = eight(tilt_right=0.05, tilt_left=0.02)
    found = structure(linear)
    (pole,) = found.poles
    assert (pole.value, pole.count, found.controllable) == (0.0, 8, 8)
    ranks = [np.linalg.matrix_rank(np.linalg.matrix_power(linear.A, k)) for k in range(1, 5)]
    assert ranks == [5, 2, 1, 0]  # of Jordan blocks of sizes 4, 2 and 2


def test_the_time_invariant_model_is_controllable_and_its_jordan_form_has_a_double_integrator() -> None:
    A, B = design_model(Settings())
    H, names = measurement_matrix(Settings(), "appendix_f"), (("x", "vx", "psi", "psi_dot", "a"), FOUR[2:])
    point = Point(0.0, np.zeros(5), np.zeros(2))
    outputs = ("psi", "psi_dot", "ax")
    found = structure(Linear(A, B, H, np.zeros((3, 2)), *names, outputs, point, np.zeros(5), np.zeros(3), {}, "5.33"))
    assert (found.controllable, found.observable) == (5, 3)
    assert found.condition == pytest.approx(224_256, abs=0.5)  # §5.5 prints 22425
    values = {round(p.value.real, 4): (p.count, p.observable) for p in found.poles}
    assert values == {0.0: (3, False), -0.3546: (1, False), -11.3122: (1, True)}
    ranks = [np.linalg.matrix_rank(np.linalg.matrix_power(A, k)) for k in (1, 2)]
    assert ranks == [3, 2]  # of Jordan blocks of sizes 2 and 1 at 0


@pytest.mark.parametrize(("slow", "stable"), [(-1.0, True), (0.0, False), (1.0, False)])
def test_a_fast_pole_does_not_decide_on_the_stability_of_a_slow_one(slow: float, stable: bool) -> None:
    none, names, point = np.zeros((2, 0)), ("fast", "slow"), Point(0.0, np.zeros(2), np.zeros(0))
    rest = names, (), (), point, np.zeros(2), np.zeros(0), {}, "by hand"
    linear = Linear(np.diag([-1e7, slow]), none, none.T, np.zeros((0, 0)), *rest)
    found = structure(linear)
    assert found.stable is stable
    assert max(p.value.real for p in found.poles) == slow
    assert headline(found, linear)


# Other systems: every one by the same verb.


@pytest.fixture
def tank(tmp_path: Path) -> Path:
    (tmp_path / "tank.py").write_text(MODEL, encoding="utf-8")
    return tmp_path / "tank.py"


def test_a_tank_has_the_pole_of_its_outlet(tank: Path) -> None:
    # A·ḣ = q − k·√h: ∂ḣ/∂h = −k/(2·A·√h)
    found = linearize(f"{tank}:Tank", at=["level=4"]).first
    assert found.A.tolist() == [[pytest.approx(-0.02 / (2 * 0.5 * 2.0), rel=1e-12)]]
    assert found.B.tolist() == [[2.0]]
    assert found.rates[0] == pytest.approx((0.02 - 0.02 * 2.0) / 0.5)


def test_the_exports_hold_the_same_numbers(tank: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    found = linearize(f"{tank}:Tank", out, at=["level=0.25"]).first
    content = json.loads((out / "linear.json").read_text(encoding="utf-8"))
    jsonschema.validate(content, json.loads(SCHEMA.read_text(encoding="utf-8")))
    mat, before = scipy.io.loadmat(out / "linear.mat"), (out / "linear.mat").read_bytes()
    system = runpy.run_path(str(out / "linear.py"))["system"]
    for name in "ABCD":
        for exported in (content["models"][0][name], mat[name], getattr(system, name), getattr(found.ss(), name)):
            assert np.array_equal(exported, getattr(found, name))
    linearize(f"{tank}:Tank", out, at=["level=0.25"], force=True)
    assert (out / "linear.mat").read_bytes() == before  # no time of day in it
    assert "Imaginary part of the poles" in (out / "report.html").read_text(encoding="utf-8")


# FMUs and scenarios.


def test_an_fmu_s_own_slopes_and_differences_are_the_equations_exact_ones(native_plant: Path) -> None:
    at = ["phi_state=0.05", "vx_state=0.4", "tilt_right_state=0.15", "duty_right=6.5"]
    exact = linearize("base", at=["phi=0.05", "vx=0.4", "tilt_right=0.15", "duty_right=6.5"]).first
    # `tilt_right` is a state and an input of the equations: both are set; the FMU's input stays at 0, and so does B
    # a difference over 2e-5 of rates of 1e2 is rounded by 1e-9; curvature adds h² of 1e2
    for step, method, digits in ((None, "directional", 1e-10), (1e-5, "central differences", 1e-6)):
        found = linearize(native_plant, at=at, step=step).first
        assert method in found.method
        rows = [found.states.index(f"{n}_state") for n in exact.states]
        assert np.abs(found.A[np.ix_(rows, rows)] - exact.A).max() < digits
        assert np.abs(found.B[rows] - exact.B).max() < digits
        assert np.abs(found.C[:, rows] - exact.C).max() < digits


def test_a_moment_of_a_scenario_is_the_state_that_the_run_has_there(project: Path) -> None:
    scenario = project / "scenarios" / "regulate.yaml"
    outcome = linearize("base", at=[f"{scenario}@0:0.4:0.2"])
    first, _, last = outcome.linear
    assert [linear.point.time for linear in outcome.linear] == pytest.approx([0.0, 0.2, 0.4])
    start = dict(zip(first.states, first.point.states, strict=True))
    assert (start["x"], start["psi"]) == (1.0, 1.0)
    assert outcome.notes == ()  # driven alike, the equations and the FMU show the same
    assert last.point.states[0] < 1.0
    assert not np.array_equal(first.A, last.A)


# Bad input.


def test_what_does_not_fit_is_refused(tank: Path, project: Path, plant_fmu: Path) -> None:
    scenario = project / "scenarios" / "regulate.yaml"
    wrong: list[tuple[object, list[str], dict[str, object], int]] = [
        ("", ["lewel=1,inflow=many"], {}, 2),
        ("", ["level"], {}, 1),
        ("", [], {"set": ["aera=1"]}, 1),
        ("", [], {"states": ["lewel"], "inputs": ["level"], "outputs": ["inflow"]}, 3),
        ("", [f"{scenario}@1"], {}, 1),
        ("base", [f"{scenario}@11"], {}, 1),
        ("base", [f"{scenario}@1"], {"component": "plont"}, 1),
        ("base", [], {"residualize": ["x"]}, 1),
        (plant_fmu, [], {}, 1),  # for co-simulation alone
    ]
    for model, at, more, faults in wrong:
        with pytest.raises(InputError) as told:
            linearize(model or f"{tank}:Tank", at=at, **more)  # type: ignore[arg-type]
        assert (told.value.exit_code, len(told.value.faults)) == (2, faults), (model, at, more, str(told.value))
