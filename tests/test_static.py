"""Models without states: their logs are tables, whose rows stand each for itself."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.estimation.data import folds
from cosim.estimation.posing import build_problem
from cosim.experiment.excite import excite
from cosim.fmi.fmu_build import build
from cosim.fmi.native.compiler import compiler
from cosim.kernel.c_filter import CompiledKernel
from cosim.kernel.generate import generate
from cosim.kernel.kernel import Data
from cosim.loading.file import load_model, read_model
from cosim.logs.log import read_log
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.refine_page import write_refine_report
from cosim.refinement.study import read_study
from cosim.refinement.workflow import refine
from cosim.residuals.workflow import replay
from cosim.subject.model_subject import ModelSubject
from cosim.verbs.check_verb import check as check_files
from tests.studies import holds, named, proven
from tests.valve import NOISE, VALVE, study_of

C0, LEAK = 0.0102, 0.03  # of the real valve; the model's coefficient is 0.01


def linear(opening: Array, drop: Array) -> Array:
    return C0 * opening * np.sqrt(drop)


def leaking(opening: Array, drop: Array) -> Array:
    return C0 * (opening + LEAK) * np.sqrt(drop)


def columns(folder: Path, name: str = "a.csv") -> tuple[Array, Array, Array]:
    """Opening, drop and flow as they were written."""
    drop, flow, opening = np.loadtxt(folder / name, delimiter=",", skiprows=1).T
    return opening, 1000.0 * drop, flow


def left_out(basis: Array, y: Array) -> float:
    """Root mean square on rows left out, of a fit of the others by least squares."""
    keep = ~np.eye(len(y), dtype=bool)
    missed = [y[k] - basis[k] @ np.linalg.lstsq(basis[keep[k]], y[keep[k]])[0] for k in range(len(y))]
    return float(np.sqrt(np.mean(np.square(missed))))


@pytest.fixture(scope="module")
def leak(tmp_path_factory: pytest.TempPathFactory) -> Refinement:
    """A valve whose seat leaks, and a sealed table of it."""
    folder = tmp_path_factory.mktemp("leak")
    return proven(study_of(folder, leaking, sealed=10), folder / "out")


# -- what is found ----------------------------------------------------------------------------------


def test_an_effect_is_found_in_a_table(leak: Refinement) -> None:
    assert (leak.record["verdict"], named(leak)) == ("effect_found", {"seat_leak"}), leak.record["sentence"]
    assert holds(leak, "seat_leak", "share", LEAK)


def test_errors_on_rows_left_out_are_those_of_least_squares(leak: Refinement) -> None:
    opening, drop, flow = columns(leak.study.path.parent)
    errors, root = leak.record["error"]["left_out"], np.sqrt(drop)
    given = float(np.sqrt(np.mean((flow - 0.01 * opening * root) ** 2)))
    assert errors["before"]["flow"] == pytest.approx(given, rel=1e-6)  # nothing is fitted
    alone = np.column_stack([opening * root])
    # the tolerance of 10 % pulls the coefficient, known to a tenth of that and better, towards the data sheet
    assert errors["recalibrated"]["flow"] == pytest.approx(left_out(alone, flow), rel=0.02)
    both = np.column_stack([opening * root, root])
    assert errors["after"]["flow"] == pytest.approx(left_out(both, flow), rel=0.02)
    assert errors["after"]["flow"] < 1.3 * NOISE < 0.5 * errors["recalibrated"]["flow"]


def test_the_fmu_predicts_each_row_from_its_own_inputs(leak: Refinement) -> None:
    found = read_model(leak.folder / "model.yaml").parameters
    for part, name in (("estimation", "a.csv"), ("validation", "v.csv")):
        opening, drop, flow = columns(leak.study.path.parent, name)
        model = found["coefficient"] * (opening + found["seat_leak.share"]) * np.sqrt(drop)
        error = leak.record["error"]["after"][part]["flow"]
        assert error == pytest.approx(float(np.sqrt(np.mean((flow - model) ** 2))), rel=1e-6)
    assert (leak.record["horizon"], leak.record["horizons"]) == ("row", {})


def test_the_report_of_a_table_knows_no_time(leak: Refinement, tmp_path: Path) -> None:
    write_refine_report(tmp_path / "report.html", leak)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "1 table used for the fits, 24 rows" in page
    assert "Rows left out" in page
    assert page.count("opening [1]") == page.count("flow in kg/s over opening in 1") + 2  # residuals beside
    assert "drop [kPa]" in page  # in the unit of the table
    shown = re.sub(r"<[^>]*>", " ", page.partition("<main>")[2].partition("How to repeat it")[0])
    assert not re.search(r"\[s\]|\btime|free run|\bruns\b", shown)


@pytest.mark.thorough
def test_nothing_missing_is_no_effect_and_leaves_the_model(tmp_path: Path) -> None:
    r = proven(study_of(tmp_path, lambda o, d: linear(o, d) / 1.02), tmp_path / "out")
    assert (r.record["verdict"], r.record["effects"]) == ("no_effect", []), r.record["sentence"]
    errors = r.record["error"]
    assert errors["before"] == errors["after"]
    assert errors["left_out"]["after"] == errors["left_out"]["before"]


@pytest.mark.thorough
def test_a_number_far_off_is_a_parameter_error(tmp_path: Path) -> None:
    r = proven(study_of(tmp_path, lambda o, d: 0.013 * o * np.sqrt(d)), tmp_path / "out")
    assert (r.record["verdict"], named(r)) == ("parameter_error", {"coefficient"}), r.record["sentence"]
    assert holds(r, "coefficient", "value", 0.013)


@pytest.mark.thorough
def test_what_is_in_no_catalogue_is_unexplained_and_told_by_its_input(tmp_path: Path) -> None:
    def notched(opening: Array, drop: Array) -> Array:
        return linear(opening, drop) * (1.0 + 0.05 * np.sin(12.0 * opening))

    r = proven(study_of(tmp_path, notched, rows=30), tmp_path / "out")
    assert r.record["verdict"] == "unexplained", r.record["sentence"]
    assert (r.record["residual"]["equation"], r.record["residual"]["signals"]) == ("flow", ["opening"])
    assert r.record["sentence"].startswith("Something outside the catalogue acts on flow; it depends on opening.")
    assert (tmp_path / "out" / "nearest.yaml").is_file()


@pytest.mark.thorough
def test_a_claim_that_leaves_much_over_an_input_is_one_of_a_part(tmp_path: Path) -> None:
    def both(opening: Array, drop: Array) -> Array:
        return C0 * (opening + 2.0 * LEAK) * np.sqrt(drop) + 0.1 * np.sin(12.0 * opening)

    r = proven(study_of(tmp_path, both, rows=40), tmp_path / "out")
    assert (named(r), r.record["grade"]) == ({"seat_leak"}, "part"), r.record["sentence"]
    assert "The model lacks seat_leak" in r.record["sentence"]
    assert "The rest acts on flow and depends on opening." in r.record["sentence"]


# -- rows -------------------------------------------------------------------------------------------


def problem_of(path: Path, order: slice = slice(None)) -> tuple[Array, float]:
    """Errors of the model as it is, row by row, and their likelihood."""
    model = load_model("valve.py:Valve", path.parent).model
    log = read_log(path.parent / "a.csv", model.inputs, model.outputs, table=True)
    turned = {side: {n: v[order] for n, v in getattr(log, side).items()} for side in ("inputs", "outputs")}
    problem = build_problem(ModelSubject.of(model), [replace(log, inputs=turned["inputs"], outputs=turned["outputs"])])
    scored = problem.score(problem.values, problem.plain)
    return scored.errors, scored.nll


def test_the_order_of_rows_says_nothing(tmp_path: Path) -> None:
    path = study_of(tmp_path, leaking)
    (errors, nll), (backwards, same) = problem_of(path), problem_of(path, slice(None, None, -1))
    opening, drop, flow = columns(tmp_path)
    np.testing.assert_allclose(errors, flow - 0.01 * opening * np.sqrt(drop), atol=1e-12)  # none is left for settling
    np.testing.assert_array_equal(backwards, errors[::-1])
    assert same == pytest.approx(nll, rel=1e-12)


def test_few_rows_are_left_out_one_by_one_and_many_in_parts_spread_over_the_table() -> None:
    def table(rows: int) -> Data:
        values = np.arange(rows, dtype=np.float64)[:, None]
        return Data(1.0, 0.0, values, np.where(values == 3.0, np.nan, values), 1, table=True)

    assert [part.u.ravel().tolist() for part in folds([table(6)])] == [[0.0], [1.0], [2.0], [4.0], [5.0]]
    parts = folds([table(301), table(101)])
    assert len(parts) == 20
    assert {len(part.u) for part in parts} == {20}
    assert all(np.ptp(part.u) >= 95.0 for part in parts)
    rows = np.concatenate([part.u.ravel() for part in parts])
    assert sorted(rows) == sorted([*np.delete(np.arange(301.0), 3), *np.delete(np.arange(101.0), 3)])


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_the_kernel_filters_and_runs_a_model_without_states(tmp_path: Path) -> None:
    u = np.array([[0.2, 1e5], [0.8, 2e5], [0.5, 1e5]])
    data = Data(1.0, 0.0, u, np.ones((3, 1)), 1, interpolated=frozenset({"opening", "drop"}), table=True)
    flow = 0.01 * u[:, 0] * np.sqrt(u[:, 1])
    nothing = np.zeros(0)
    model = load_model("valve.py:Valve", study_of(tmp_path, leaking).parent).model
    kernel = CompiledKernel(generate(model, ("flow",)))
    assert kernel.layout.states == kernel.layout.forced == ()
    p = np.array([0.01 if name == "coefficient" else 0.0 for name in kernel.layout.parameters])
    filtered = kernel.run(data, p, nothing, np.zeros((0, 0)), nothing, np.array([4.0]), states=True)
    np.testing.assert_allclose(filtered.errors[:, 0], 1.0 - flow, rtol=1e-12)
    assert (filtered.variances == 4.0).all()
    np.testing.assert_allclose(kernel.simulate(data, p, nothing, nothing).outputs[:, 0], flow, rtol=1e-12)


# -- bad input --------------------------------------------------------------------------------------

BAD = [
    ("opening,drop,flow\n0.5,1e5,1.5\n", "a.csv:2:1: holds one row; a table has at least two"),
    ("opening,drop,flow\n", "a.csv:2:1: holds no row"),
    ("opening,drop,flow,opening\n0.5,1e5,1,0.5\n0.6,1e5,2,1\n", r'a.csv:1:4: column "opening" stands twice, first as'),
    ("opening,flow\n0.5,1\n0.6,2\n", 'a.csv:1:1: input "drop" is missing; a table holds every input'),
    ("opening,drop,flow [K]\n0.5,1e5,1\n0.6,1e5,2\n", 'a.csv:1:3: "K" is no unit of flow'),
    ("opening,drop,flow\n0.5,1e5,1\n0.6,1e5,\n", "a.csv:1:1: something is measured in 1 row; it takes 2"),
    ("opening,drop,flow\n0.5,1e5,1\n,1e5,2\n", "a.csv:3:1: opening has no value here"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_a_bad_table_is_refused_with_place_and_cure(tmp_path: Path, text: str, message: str) -> None:
    path = study_of(tmp_path, linear)
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=re.escape(message)):
        read_study(path)


def test_all_faults_of_a_table_come_at_once_and_nothing_is_written(tmp_path: Path) -> None:
    path = study_of(tmp_path, linear)
    (tmp_path / "a.csv").write_text("opening,drop,flow,drop\n0.5,1e5,1,1e5\n")
    with pytest.raises(InputError) as refused:
        refine(path, tmp_path / "out")
    assert refused.value.exit_code == 2
    assert [(f.line, f.column) for f in refused.value.faults] == [(1, 4), (2, 1)]
    assert not (tmp_path / "out").exists()


def test_rows_too_few_to_tell_an_effect_from_noise_are_refused(tmp_path: Path) -> None:
    """A coefficient, an effect, three rows more: five are enough, in whatever files."""
    path = study_of(tmp_path, linear, rows=4)
    with pytest.raises(
        InputError, match=r"study.yaml:3:\d+: the logs of estimation have 4 rows, and a study needs 5: 1 number that"
    ):
        read_study(path)
    assert read_study(study_of(tmp_path, linear, rows=5)).logs


def test_parameters_per_log_of_a_table_are_refused(tmp_path: Path) -> None:
    path = study_of(tmp_path, linear)
    path.write_text(path.read_text() + "per_log: [meter_offset]\n")
    with pytest.raises(InputError, match="parameters per log are not for tables"):
        read_study(path)


def test_a_time_that_a_table_does_not_need_is_noted_and_not_read(tmp_path: Path) -> None:
    study_of(tmp_path, linear)
    text = (tmp_path / "a.csv").read_text().splitlines()
    dated = ["time," + text[0], *(f"12:{k % 2},{row}" for k, row in enumerate(text[1:]))]
    (tmp_path / "b.csv").write_text("\n".join(dated))
    said = check_files(tmp_path / "b.csv", f"{tmp_path}/valve.py:Valve")
    assert len(said) == 1
    assert "note: time is not read" in said[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("return (self.coefficient * ", "return (self.coefficient * m.exp(-t) * ", "let no output depend on time"),
        (
            '    equation = "opening + l"',
            '    equation = ""\n    states = (Quantity("x", "1", "x"),)',
            "seat_leak keeps",
        ),
        ("import Bias", "import Drift as Bias", "meter_offset depends on time"),
    ],
)
def test_a_model_without_states_that_goes_with_time_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert VALVE.count(old) == 1
    (tmp_path / "valve.py").write_text(VALVE.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        check_files(tmp_path / "valve.py")


# -- other commands ---------------------------------------------------------------------------------


def test_the_fmu_is_valid_and_follows_its_inputs_at_once(tmp_path: Path) -> None:
    from fmpy import simulate_fmu

    study_of(tmp_path, linear)
    fmu = build(load_model("valve.py:Valve", tmp_path).recipe(), tmp_path / "plant.fmu")
    assert check_files(fmu) == []
    for opening in (0.3, 0.9):
        found = simulate_fmu(str(fmu), start_values={"opening": opening}, stop_time=1.0, output_interval=0.5)
        np.testing.assert_allclose(found["flow"], 0.01 * opening * np.sqrt(1e5), rtol=1e-12)
    with pytest.raises(InputError, match="has no states, so there is no time over which to replay"):
        replay(tmp_path / "a.csv", tmp_path / "out", fmu)


def test_no_experiment_is_drawn_for_a_model_without_states(tmp_path: Path) -> None:
    study_of(tmp_path, linear)
    with pytest.raises(InputError, match="has no states, so an input over time adds no information"):
        excite(f"{tmp_path}/valve.py:Valve", tmp_path / "out", limits=["opening=0.3"])
    assert not (tmp_path / "out").exists()
