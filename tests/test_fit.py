"""`cosim fit`: parameters and start values of any FMU from logs, against truths that are known."""

from __future__ import annotations

import json
import math
import shutil
import zipfile
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from scipy.signal import lfilter

import cosim
from cosim.calibration import fitted_fmu
from cosim.core.errors import InputError, SimulationError, TimedOut
from cosim.files.kinds import kind_of
from cosim.verbs.checks import schema_of
from tests.cases import some
from tests.fit_head_to_head import CASES, Bench, by_cosim, by_scipy
from tests.logs import write_log
from tests.slider import PARAMETERS, TRUTH, slide, slider_fmu, slider_log
from tests.warm import cosim as command

QUICK: dict[str, Any] = {"in_process": True, "report": False}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the FMU and three logs."""
    folder = tmp_path_factory.mktemp("bench")
    slider_fmu(folder / "slider.fmu")
    for seed, name in enumerate(("a.csv", "b.csv", "c.csv"), 1):
        slider_log(folder / name, seed=seed, start=(0.3 - 0.2 * seed, 0.1 * seed - 0.4), seconds=15.0)
    return folder


def holds(fitted: Any, **truth: float) -> bool:
    """Return whether every interval, widened by a half, holds its truth; one in a hundred misses by chance."""
    return all(abs(fitted.values[n] - v) < 0.75 * (np.ptp(fitted.intervals[n])) for n, v in truth.items())


# -- estimates ----------------------------------------------------------------------------------------


def test_two_logs_give_the_truth_and_sealed_logs_prove_it(bench: Path, tmp_path: Path) -> None:
    fitted = cosim.fit(
        [bench / "a.csv", bench / "b.csv"],
        bench / "slider.fmu",
        tmp_path / "out",
        vary=["mass=0.3..5 kg", "damping"],
        sealed=[bench / "c.csv"],
        in_process=True,
    )
    assert holds(fitted, mass=1.6, damping=0.8)
    assert fitted.verdict == "improved"
    record = fitted.record
    jsonschema.validate(
        json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8")), schema_of("fit_result")
    )
    errors = record["errors"]["sealed"]["channels"]["velocity"]
    assert errors["after"] < 1.2 * errors["noise_floor"] < 0.2 * errors["before"]
    assert {(Path(s["log"]).name, s["name"]) for s in record["starts"]} == {
        (log, name) for log in ("a.csv", "b.csv") for name in ("position", "velocity_start")
    }
    assert record["simulations"] < 90
    assert (tmp_path / "out" / "report.html").is_file()
    assert cosim.read(tmp_path / "out").values == fitted.values  # type: ignore[union-attr]
    assert kind_of(tmp_path / "out" / "fit.json") == "an answer of `cosim fit`"
    # the library has its values compiled in, so a wrapper sets them
    again = cosim.replay(bench / "c.csv", fmu=tmp_path / "out" / "fitted.fmu")
    assert float(np.nanstd(again.residual["free_run.velocity"])) < 1.2 * errors["noise_floor"]  # type: ignore[index]
    ssv = (tmp_path / "out" / "fitted.ssv").read_text()
    assert 'name="mass"' in ssv
    assert 'unit="kg"' in ssv
    assert list(fitted.to_pandas()["parameter"]) == ["mass", "damping"]


@pytest.mark.parametrize(("version", "exchange"), some([(3, True), (3, False), (2, True)], every=3))
def test_every_kind_of_fmu_gives_the_same(bench: Path, tmp_path: Path, version: int, exchange: bool) -> None:
    fmu = slider_fmu(tmp_path / "slider.fmu", version, exchange=exchange)
    log = slider_log(tmp_path / "a.csv", seconds=6.0)
    fitted = cosim.fit([log], fmu, vary=["mass=1..3"], start={"damping": 0.8}, **QUICK)
    assert holds(fitted, mass=1.6)


def test_missing_cells_rows_and_other_names_are_read_as_by_replay(tmp_path: Path) -> None:
    columns = slide(0.05 * np.arange(401), TRUTH, (0.3, -0.4))
    rng = np.random.default_rng(3)
    speed = columns.pop("velocity") + 0.01 * rng.standard_normal(401)
    speed[rng.uniform(size=401) < 0.3] = math.nan
    kept = np.setdiff1d(np.arange(401), np.arange(150, 155))
    columns["position"] += 2e-3 * rng.standard_normal(401)
    log = write_log(tmp_path / "a.csv", {n: v[kept] for n, v in {**columns, "v_mm [mm/s]": 1000.0 * speed}.items()})
    fmu = slider_fmu(tmp_path / "slider.fmu")
    fitted = cosim.fit([log], fmu, vary=["mass", "damping"], columns={"v_mm": "velocity"}, **QUICK)
    assert holds(fitted, mass=1.6, damping=0.8)


def test_an_unknown_start_that_no_output_shows_is_estimated_where_it_is_named(tmp_path: Path) -> None:
    logs = [
        slider_log(tmp_path / f"{k}.csv", seed=k, start=(0.1 * k, 0.3 * k), outputs=("position",), seconds=8.0)
        for k in (1, 2)
    ]
    fmu = slider_fmu(tmp_path / "slider.fmu")
    fitted = cosim.fit(logs, fmu, vary=["mass", "velocity_start"], start={"damping": 0.8}, **QUICK)
    speeds = [s for s in fitted.record["starts"] if s["named"]]
    assert [s["value"] for s in speeds] == pytest.approx([0.3, 0.6], abs=0.02)
    assert [s["ci95"][0] < v < s["ci95"][1] for s, v in zip(speeds, (0.3, 0.6), strict=True)] == [True, True]
    assert set(fitted.values) == {"mass"}


def test_a_prior_holds_what_the_log_does_not_show(bench: Path) -> None:
    vary, fixed = {"gain": "10%", "mass": None}, {"damping": 0.8}
    fitted = cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=vary, start=fixed, **QUICK)
    assert fitted.values["mass"] / fitted.values["gain"] == pytest.approx(0.8, rel=0.01)
    low, high = fitted.intervals["gain"] or (0.0, 0.0)
    assert (fitted.values["gain"], high - low) == (pytest.approx(2.0, abs=0.1), pytest.approx(0.4, rel=0.1))


# -- what can be told apart ---------------------------------------------------------------------------


def test_two_parameters_that_act_as_a_ratio_are_said_to_and_have_no_interval(bench: Path) -> None:
    fitted = cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=["mass", "gain", "damping"], **QUICK)
    (combination,) = fitted.record["combinations"]
    assert (combination["form"], combination["expression"], combination["held"]) == ("ratio", "mass / gain", "gain")
    assert (fitted.values["gain"], fitted.intervals["gain"], fitted.intervals["mass"]) == (2.0, None, None)
    assert fitted.values["mass"] == pytest.approx(1.6, rel=0.01)
    assert len(fitted.record["warnings"]) >= 1


def test_without_vary_the_identifiable_parameters_are_chosen_with_reasons(bench: Path) -> None:
    fitted = cosim.fit([bench / "a.csv"], bench / "slider.fmu", **QUICK)
    choices = {c["name"]: c for c in fitted.record["screening"]}
    assert set(choices) == {n for n in PARAMETERS if n != "velocity_start"}
    chosen = {n for n, c in choices.items() if c["estimated"]}
    assert chosen in ({"mass", "damping", "offset"}, {"gain", "damping", "offset"})
    (other,) = {"mass", "gain"} - chosen
    assert choices[other]["reason"] != choices["idle"]["reason"]
    assert fitted.values["damping"] == pytest.approx(0.8, rel=0.02)
    assert fitted.verdict == "improved"


def test_a_named_parameter_without_effect_keeps_its_value_and_is_told(bench: Path) -> None:
    fitted = cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=["mass", "idle"], **QUICK)
    assert (fitted.values["idle"], fitted.intervals["idle"]) == (3.0, None)
    with pytest.raises(InputError):
        cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=["idle"], **QUICK)


@pytest.mark.thorough
def test_windows_replace_free_runs_that_drift(tmp_path: Path) -> None:
    rng, rows, h = np.random.default_rng(1), 401, 0.05
    force, pull = np.repeat(rng.uniform(-1.0, 1.0, 41), 10)[:rows], np.cumsum(0.02 * rng.standard_normal(rows))
    speed = np.cumsum(h * (2.0 / 1.6 * force + pull))
    columns = {"position": np.cumsum(h * speed) + 2e-3 * rng.standard_normal(rows), "velocity": speed}
    log = write_log(tmp_path / "a.csv", {"time": h * np.arange(rows), "force": force, **columns})
    fmu = slider_fmu(tmp_path / "slider.fmu")
    fitted = cosim.fit([log], fmu, vary=["mass"], start={"damping": 0}, **QUICK)
    assert fitted.record["windows"] == 2.0
    assert "a free run misses" in fitted.record["windows_reason"]
    assert fitted.values["mass"] == pytest.approx(1.6, abs=0.5)
    assert any("stays above the noise and is not white" in w for w in fitted.record["warnings"])


# -- failures -----------------------------------------------------------------------------------------


def test_a_crash_at_some_values_costs_one_simulation(tmp_path: Path) -> None:
    log = slider_log(tmp_path / "a.csv", {**TRUTH, "mass": 0.8}, seconds=6.0)
    fmu = slider_fmu(tmp_path / "slider.fmu")
    start = {"fragile": 0.75, "mass": 3, "damping": 0.8, "gain": 2}
    fitted = cosim.fit([log], fmu, vary=["mass"], start=start, report=False)
    assert fitted.values["mass"] == pytest.approx(0.8, rel=0.01)
    assert fitted.record["failed_simulations"] > 0
    assert any("simulations failed and were rejected" in w for w in fitted.record["warnings"])


def test_an_fmu_that_fails_before_the_fit_is_an_error(tmp_path: Path) -> None:
    log, fmu = slider_log(tmp_path / "a.csv", seconds=6.0), slider_fmu(tmp_path / "slider.fmu")
    with pytest.raises(SimulationError, match="fmi2DoStep"):
        cosim.fit([log], fmu, tmp_path / "out", vary=["mass"], start={"fragile": 9}, report=False)
    assert not (tmp_path / "out" / "fit.json").exists()


def test_a_spent_budget_and_ctrl_c_leave_the_best_values(bench: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def spend(stage: str, share: float) -> None:
        if stage == "fitting, iteration 2":
            monkeypatch.setattr("time.monotonic", lambda: 1e12)

    def interrupt(stage: str, share: float) -> None:
        if stage == "fitting, iteration 2":
            raise KeyboardInterrupt

    arguments = ([bench / "a.csv"], bench / "slider.fmu", tmp_path / "out")
    with pytest.raises(TimedOut, match="the limit of 600 s") as late:
        cosim.fit(*arguments, vary=["mass"], limits="total: 600 s", in_process=True, progress=spend)
    monkeypatch.undo()
    with pytest.raises(SimulationError, match="keyboard") as stopped:
        cosim.fit(*arguments, vary=["mass"], sealed=[bench / "b.csv"], in_process=True, force=True, progress=interrupt)
    assert (late.value.exit_code, stopped.value.exit_code) == (124, 130)
    left = cosim.read(tmp_path / "out")
    assert left.verdict == "stopped"  # type: ignore[union-attr]
    assert left.record["errors"] == {}  # type: ignore[union-attr]
    assert (tmp_path / "out" / "report.html").exists()


def test_all_faults_of_arguments_and_logs_are_told_at_once(bench: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("time,force\n0,1\n1,x\n")
    wrong = ["mas", "force", "mass=0..", "gain=3..1", "damping=200 kg..3", "idle=-1%", "offset=5%", "velocity"]
    with pytest.raises(InputError) as refused:
        cosim.fit([bench / "a.csv", tmp_path / "bad.csv"], bench / "slider.fmu", vary=wrong, start=["x=1"], **QUICK)
    assert len(refused.value.faults) >= 10
    assert refused.value.exit_code == 2
    with pytest.raises(InputError, match="named twice"):
        cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=["mass"], sealed=[bench / "a.csv"], **QUICK)
    with pytest.raises(InputError, match="starts at 1, outside 2 to 3; give another value as --start mass=VALUE"):
        cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary={"mass": (2, 3)}, **QUICK)


def test_a_parameter_has_a_value_for_each_log_on_request(bench: Path, tmp_path: Path) -> None:
    masses = {"a.csv": 1.2, "b.csv": 2.4}
    logs = [slider_log(tmp_path / n, TRUTH | {"mass": m}, seed=k) for k, (n, m) in enumerate(masses.items(), start=5)]
    study = tmp_path / "study.yaml"
    shutil.copy(bench / "slider.fmu", tmp_path)
    study.write_text("model: slider.fmu\nlogs: {estimation: [a.csv, b.csv]}\nvary: [damping]\nper_log: [mass]\n")
    for fitted in (
        cosim.fit(logs, bench / "slider.fmu", vary=["damping"], per_log=["mass"], **QUICK),
        cosim.fit(study, out=tmp_path / "out", **QUICK),
    ):
        assert holds(fitted, damping=0.8)
        found = {Path(e["log"]).name: e for e in fitted.record["per_log"]}
        assert {n: e["value"] for n, e in found.items()} == pytest.approx(masses, rel=0.02)
        assert all(e["ci95"][0] < masses[n] < e["ci95"][1] for n, e in found.items())
        assert fitted.record["parameters"].keys() == {"damping"}
        assert fitted.verdict == "improved"
    common = cosim.fit(logs, bench / "slider.fmu", vary=["damping", "mass"], **QUICK)
    name = "velocity"
    errors = [f.record["errors"]["estimation"]["channels"][name]["after"] for f in (fitted, common)]
    assert errors[0] < 0.2 * errors[1]
    with pytest.raises(InputError) as refused:
        cosim.fit(logs, bench / "slider.fmu", per_log=["mas"], **QUICK)
    assert len(refused.value.faults) == 1


def test_a_profile_is_the_likelihood_with_the_others_estimated_anew(bench: Path, tmp_path: Path) -> None:
    fitted = cosim.fit([bench / "a.csv"], bench / "slider.fmu", tmp_path / "out", vary=["mass", "damping"],
                       profile=["mass"], **QUICK)  # fmt: skip
    entry = fitted.record["parameters"]["mass"]
    low, high = entry["profile"]["ci95"]
    assert low < entry["value"] < high
    assert entry["profile"]["deviance"][entry["profile"]["values"].index(entry["value"])] == 0.0
    assert (low, high) == (pytest.approx(entry["ci95"][0], rel=0.02), pytest.approx(entry["ci95"][1], rel=0.02))
    held = cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=["damping"], start={"mass": high}, **QUICK)
    deviance = 2.0 * (cost(held, bench / "a.csv") - cost(fitted, bench / "a.csv"))
    # the scale between a white and a coloured residual is the square of the ratio of both standard deviations
    at_end = entry["profile"]["deviance"][entry["profile"]["values"].index(high)]
    assert at_end == pytest.approx(1.96**2, abs=0.1)
    assert 0.3 * at_end < deviance < 3.0 * at_end
    assert fitted.record["parameters"]["damping"]["profile"] is None
    with pytest.raises(InputError) as refused:
        cosim.fit([bench / "a.csv"], bench / "slider.fmu", vary=["damping"], profile=["mass", "damp"], **QUICK)
    assert len(refused.value.faults) == 2


def cost(fitted: Any, log: Path) -> float:
    """Return −ln L of the residuals of a fit, with the noise levels at their best."""
    rows = len(log.read_text().splitlines()) - 1
    return sum(rows * math.log(entry["sigma"]) for entry in fitted.record["noise"].values())


# -- files --------------------------------------------------------------------------------------------


def test_an_fmu_whose_library_follows_its_file_gets_a_copy_with_the_values(bench: Path, tmp_path: Path) -> None:
    fmu = slider_fmu(tmp_path / "slider.fmu", follow=True)
    fitted = cosim.fit([bench / "a.csv"], fmu, tmp_path / "out", vary=["mass", "damping"], **QUICK)
    copy = tmp_path / "out" / "fitted.fmu"
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(copy) as new:
        assert old.namelist() == new.namelist()
        assert [n for n in old.namelist() if old.read(n) != new.read(n)] == ["modelDescription.xml"]
        assert f'start="{fitted.values["mass"]!r}"' in new.read("modelDescription.xml").decode()
    before = copy.read_bytes()
    fitted_fmu.write_copy(fmu, fitted.values, copy)
    assert copy.read_bytes() == before
    again = cosim.replay(bench / "a.csv", fmu=copy, in_process=True)
    assert float(np.nanstd(again.residual["free_run.velocity"])) < 0.02  # type: ignore[index]


# -- methods ------------------------------------------------------------------------------------------


def coverage(folder: Path, count: int, rows: int, correlation: float) -> dict[str, int]:
    """Return how many of the 95 % intervals of fits hold the truth, under noise of a correlation between rows."""
    fmu, hits = slider_fmu(folder / "slider.fmu"), dict.fromkeys(("mass", "damping", "offset"), 0)
    for seed in range(count):
        columns = slide(0.05 * np.arange(rows), TRUTH, (0.1, -0.1), seed)
        rng = np.random.default_rng([seed, 5])
        for name, sigma in (("position", 2e-3), ("velocity", 1e-2)):
            white = rng.standard_normal(rows + 500) * math.sqrt(1.0 - correlation**2)
            columns[name] += sigma * lfilter([1.0], [1.0, -correlation], white)[500:]
        fitted = cosim.fit([write_log(folder / "log.csv", columns)], fmu, vary=[*hits], **QUICK)
        for name, interval in fitted.intervals.items():
            low, high = interval or (0.0, 0.0)
            hits[name] += bool(low <= TRUTH[name] <= high)
    return hits


@pytest.mark.thorough
@pytest.mark.parametrize(("count", "correlation", "least"), [(100, 0.0, 88), (60, 0.8, 50)])  # 95 ± 7 of 100; of 60
def test_intervals_hold_the_truth(tmp_path: Path, count: int, correlation: float, least: int) -> None:
    assert min(coverage(tmp_path, count, 301, correlation).values()) >= least


# -- study files --------------------------------------------------------------------------------------

FIT_STUDY = """model: slider.fmu
logs:
  estimation: [a.csv, b.csv]
  validation: [c.csv]
vary: {mass: 0.3..5 kg, damping: }
start: {gain: 2.0}
columns: {pos: position}
"""


@pytest.mark.thorough
def test_a_study_is_the_same_fit_as_its_options(bench: Path, tmp_path: Path) -> None:
    study = bench / "fit.yaml"
    study.write_text(FIT_STUDY)
    by_study = cosim.fit(study, **QUICK)
    by_options = cosim.fit(
        [bench / "a.csv", bench / "b.csv"],
        bench / "slider.fmu",
        vary=["mass=0.3..5 kg", "damping"],
        start={"gain": 2.0},
        sealed=[bench / "c.csv"],
        **QUICK,
    )
    for name in ("parameters", "starts", "errors", "sealed", "given"):
        assert by_study.record[name] == by_options.record[name]
    assert cosim.check(study)[-1] == f"{study}: `cosim fit` will estimate mass and damping"
    done = command("fit", study, "--vary", "mass", "--no-report", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert set(json.loads((tmp_path / "out" / "fit.json").read_text())["parameters"]) == {"mass"}


def test_faults_of_a_study_stand_at_their_places(bench: Path, tmp_path: Path) -> None:
    study = bench / "wrong.yaml"
    study.write_text(
        "model: slider.fmu\nlogs: {estimation: [a.csv, a.csv, no.csv]}\n"
        "vary:\n  mas: \n  mass: 3..1\nstart: {x: 1}\n"
    )  # fmt: skip
    with pytest.raises(InputError) as refused:
        cosim.fit(study, **QUICK)
    assert sorted(f.line for f in refused.value.faults) == [2, 2, 4, 5, 6]
    study.write_text("model: tank.py:Tank\nlogs: {estimation: [a.csv]}\nvary: [mass]\n")
    with pytest.raises(InputError):
        cosim.fit(study, **QUICK)
    with pytest.raises(InputError):
        cosim.fit(study, bench / "slider.fmu", **QUICK)
    with pytest.raises(InputError):
        cosim.fit([bench / "a.csv"], **QUICK)
    assert command("refine", study).returncode == 2


@pytest.mark.thorough
def test_a_fit_is_as_accurate_as_least_squares(tmp_path: Path) -> None:
    bench = Bench(CASES[2], tmp_path)
    fit, plain = by_cosim(bench), by_scipy(bench)
    assert bench.error(fit.values) < 1.02 * bench.error(plain.values) < 0.1 * bench.error(bench.first)
    assert fit.runs < 2 * plain.runs  # with start values, identifiability and intervals
