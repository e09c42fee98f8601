"""`cosim fit`: parameters and start values of any FMU from logs, against truths that are known."""

from __future__ import annotations

import json
import math
import re
import zipfile
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

import cosim
from cosim.core.errors import InputError, SimulationError, TimedOut
from cosim.files.results import read_results
from cosim.verbs.checks import schema_of
from tests.cases import some
from tests.logs import write_log
from tests.slider import TRUTH, slide, slider_bench, slider_fmu, slider_log

QUICK: dict[str, Any] = {"in_process": True, "report": False}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the FMU and three logs."""
    return slider_bench(tmp_path_factory.mktemp("bench"))


def fit_one(bench: Path, **more: Any) -> Any:
    """Fit the first log."""
    return cosim.fit([bench / "a.csv"], bench / "slider.fmu", **more, **QUICK)


def holds(fitted: Any, **truth: float) -> bool:
    """Return whether every interval, widened by a half, holds its truth; one in a hundred misses by chance."""
    return all(abs(fitted.values[n] - v) < 0.75 * (np.ptp(fitted.intervals[n])) for n, v in truth.items())


# -- estimates ----------------------------------------------------------------------------------------

STUDY = """model: slider.fmu
logs:
  estimation: [a.csv, b.csv]
  validation: [c.csv]
vary: {mass: 0.3..5 kg, damping: }
start: {gain: 2.0}
columns: {pos: position}
"""


def test_two_logs_of_a_study_give_the_truth_and_sealed_logs_prove_it(bench: Path, tmp_path: Path) -> None:
    study, out = bench / "fit.yaml", tmp_path / "out"
    study.write_text(STUDY)
    assert cosim.check(study)
    fitted = cosim.fit(study, out=out, in_process=True)
    assert holds(fitted, mass=1.6, damping=0.8)
    assert fitted.verdict == "improved"
    record = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    jsonschema.validate(record, schema_of("fit_result"))
    errors = record["errors"]["sealed"]["channels"]["velocity"]
    assert errors["after"] < 1.2 * errors["noise_floor"] < 0.2 * errors["before"]
    assert {(Path(s["log"]).name, s["name"]) for s in record["starts"]} == {
        (log, name) for log in ("a.csv", "b.csv") for name in ("position", "velocity_start")
    }
    assert record["simulations"] < 90
    assert (out / "report.html").is_file()
    assert cosim.read(out).values == fitted.values  # type: ignore[union-attr]
    # the library has its values compiled in, so a wrapper sets them
    again = cosim.replay(bench / "c.csv", fmu=out / "fitted.fmu")
    assert float(np.nanstd(again.residual["free_run.velocity"])) < 1.2 * errors["noise_floor"]  # type: ignore[index]
    assert re.search(r'name="mass".*unit="kg"', (out / "fitted.ssv").read_text(), re.DOTALL)
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
    fitted = fit_one(bench, vary=vary, start=fixed)
    assert fitted.values["mass"] / fitted.values["gain"] == pytest.approx(0.8, rel=0.01)
    low, high = fitted.intervals["gain"] or (0.0, 0.0)
    assert (fitted.values["gain"], high - low) == (pytest.approx(2.0, abs=0.1), pytest.approx(0.4, rel=0.1))


# -- what can be told apart ---------------------------------------------------------------------------


def test_parameters_that_act_as_a_ratio_or_not_at_all_have_no_interval(bench: Path) -> None:
    fitted = fit_one(bench, vary=["mass", "gain", "damping", "idle"])
    (combination,) = fitted.record["combinations"]
    assert (combination["form"], combination["expression"], combination["held"]) == ("ratio", "mass / gain", "gain")
    assert (fitted.values["gain"], fitted.values["idle"]) == (2.0, 3.0)
    assert {name for name, interval in fitted.intervals.items() if interval} == {"damping"}
    assert fitted.values["mass"] == pytest.approx(1.6, rel=0.01)


def test_without_vary_the_identifiable_parameters_are_chosen(bench: Path) -> None:
    fitted = fit_one(bench)
    choices = {c["name"]: c["estimated"] for c in fitted.record["screening"]}
    assert set(choices) == {"mass", "gain", "damping", "offset", "idle", "fragile"}
    chosen = {n for n, is_chosen in choices.items() if is_chosen}
    assert chosen in ({"mass", "damping", "offset"}, {"gain", "damping", "offset"})
    assert fitted.values["damping"] == pytest.approx(0.8, rel=0.02)
    assert fitted.verdict == "improved"


# -- failures -----------------------------------------------------------------------------------------


def test_a_crash_at_some_values_costs_one_simulation_and_one_before_the_fit_ends_it(tmp_path: Path) -> None:
    log = slider_log(tmp_path / "a.csv", {**TRUTH, "mass": 0.8}, seconds=6.0)
    fmu = slider_fmu(tmp_path / "slider.fmu")
    start = {"fragile": 0.75, "mass": 3, "damping": 0.8, "gain": 2}
    fitted = cosim.fit([log], fmu, vary=["mass"], start=start, report=False)
    assert fitted.values["mass"] == pytest.approx(0.8, rel=0.01)
    assert fitted.record["failed_simulations"] > 0
    with pytest.raises(SimulationError):
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
    with pytest.raises(TimedOut) as late:
        cosim.fit(*arguments, vary=["mass"], limits="total: 600 s", in_process=True, progress=spend)
    monkeypatch.undo()
    with pytest.raises(SimulationError) as stopped:
        cosim.fit(*arguments, vary=["mass"], sealed=[bench / "b.csv"], in_process=True, force=True, progress=interrupt)
    assert (late.value.exit_code, stopped.value.exit_code) == (124, 130)
    left = cosim.read(tmp_path / "out")
    assert left.verdict == "stopped"  # type: ignore[union-attr]
    assert left.record["errors"] == {}  # type: ignore[union-attr]
    assert (tmp_path / "out" / "report.html").exists()


def test_all_faults_of_arguments_logs_and_studies_are_told_at_their_places(bench: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("time,force\n0,1\n1,x\n")
    study, logs, fmu = bench / "wrong.yaml", [bench / "a.csv"], bench / "slider.fmu"
    wrong = ["mas", "force", "mass=0..", "gain=3..1", "damping=200 kg..3", "idle=-1%", "offset=5%", "velocity"]
    with pytest.raises(InputError) as refused:
        cosim.fit([*logs, tmp_path / "bad.csv"], fmu, vary=wrong, start=["x=1"], **QUICK)
    assert len(refused.value.faults) >= 10
    assert refused.value.exit_code == 2
    study.write_text(
        "model: slider.fmu\nlogs: {estimation: [a.csv, a.csv, no.csv]}\n"
        "vary:\n  mas: \n  mass: 3..1\nstart: {x: 1}\n"
    )  # fmt: skip
    with pytest.raises(InputError) as refused:
        cosim.fit(study, **QUICK)
    assert sorted(f.line for f in refused.value.faults) == [2, 2, 4, 5, 6]
    study.write_text("model: tank.py:Tank\nlogs: {estimation: [a.csv]}\nvary: [mass]\n")
    given: tuple[dict[str, Any], ...] = (
        {"logs": study},
        {"logs": logs},
        {"logs": logs, "fmu": fmu, "vary": ["mass"], "sealed": logs},
        {"logs": logs, "fmu": fmu, "vary": {"mass": (2, 3)}},
        {"logs": logs, "fmu": fmu, "vary": ["idle"]},
        {"logs": logs, "fmu": fmu, "per_log": ["mas"]},
        {"logs": logs, "fmu": fmu, "vary": ["damping"], "profile": ["mass"]},
    )
    for each in given:
        with pytest.raises(InputError):
            cosim.fit(**each, **QUICK)


def test_a_parameter_has_a_value_for_each_log_on_request(bench: Path, tmp_path: Path) -> None:
    masses = {"a.csv": 1.2, "b.csv": 2.4}
    logs = [slider_log(tmp_path / n, TRUTH | {"mass": m}, seed=k) for k, (n, m) in enumerate(masses.items(), start=5)]
    fitted = cosim.fit(logs, bench / "slider.fmu", vary=["damping"], per_log=["mass"], **QUICK)
    assert holds(fitted, damping=0.8)
    found = {Path(e["log"]).name: e for e in fitted.record["per_log"]}
    assert {n: e["value"] for n, e in found.items()} == pytest.approx(masses, rel=0.02)
    assert all(e["ci95"][0] < masses[n] < e["ci95"][1] for n, e in found.items())
    assert fitted.record["parameters"].keys() == {"damping"}


def test_a_profile_ends_where_the_likelihood_has_fallen_as_far_as_its_interval_says(bench: Path) -> None:
    fitted = fit_one(bench, vary=["mass", "damping"], profile=["mass"])
    entry = fitted.record["parameters"]["mass"]
    profile = entry["profile"]
    low, high = profile["ci95"]
    deviance = dict(zip(profile["values"], profile["deviance"], strict=True))
    assert low < entry["value"] < high
    assert deviance[entry["value"]] == 0.0
    assert deviance[high] == pytest.approx(1.96**2, abs=0.1)
    assert (low, high) == pytest.approx(entry["ci95"], rel=0.02)
    assert fitted.record["parameters"]["damping"]["profile"] is None


# -- files --------------------------------------------------------------------------------------------


def test_an_fmu_whose_library_follows_its_file_gets_a_copy_with_the_values(bench: Path, tmp_path: Path) -> None:
    fmu = slider_fmu(tmp_path / "slider.fmu", follow=True)
    fitted = cosim.fit([bench / "a.csv"], fmu, tmp_path / "out", vary=["mass", "damping"], **QUICK)
    copy = tmp_path / "out" / "fitted.fmu"
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(copy) as new:
        assert [n for n in old.namelist() if old.read(n) != new.read(n)] == ["modelDescription.xml"]
        assert f'start="{fitted.values["mass"]!r}"' in new.read("modelDescription.xml").decode()
    again = cosim.replay(bench / "a.csv", fmu=copy, in_process=True)
    assert float(np.nanstd(again.residual["free_run.velocity"])) < 0.02  # type: ignore[index]


# -- methods ------------------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize(("count", "correlation", "least"), [(100, 0.0, 88), (60, 0.8, 50)])  # 95 ± 7 of 100; of 60
def test_intervals_hold_the_truth(tmp_path: Path, count: int, correlation: float, least: int) -> None:
    fmu, hits = slider_fmu(tmp_path / "slider.fmu"), dict.fromkeys(("mass", "damping", "offset"), 0)
    for seed in range(count):
        columns = slide(0.05 * np.arange(301), TRUTH, (0.1, -0.1), seed)
        rng = np.random.default_rng([seed, 5])
        for name, sigma in (("position", 2e-3), ("velocity", 1e-2)):
            white = rng.standard_normal(801) * math.sqrt(1.0 - correlation**2)
            columns[name] += sigma * lfilter([1.0], [1.0, -correlation], white)[500:]
        fitted = cosim.fit([write_log(tmp_path / "log.csv", columns)], fmu, vary=[*hits], **QUICK)
        for name, interval in fitted.intervals.items():
            low, high = interval or (0.0, 0.0)
            hits[name] += bool(low <= TRUTH[name] <= high)
    assert min(hits.values()) >= least


def test_a_fit_is_the_least_squares_of_the_exact_solution(bench: Path) -> None:
    fitted = fit_one(bench, vary=["mass", "damping"])
    log = read_results(bench / "a.csv")

    def miss(x: Any) -> Any:
        mass, damping, *start = x
        model = slide(log.time, TRUTH | {"mass": mass, "damping": damping}, start)
        return np.concatenate([(model[n] - log[n]) / sigma for n, sigma in (("position", 2e-3), ("velocity", 1e-2))])

    found = least_squares(miss, [1.0, 0.5, 0.1, -0.3]).x
    for name, value in zip(("mass", "damping"), found, strict=False):
        assert fitted.values[name] == pytest.approx(value, abs=0.05 * float(np.ptp(fitted.intervals[name])))
