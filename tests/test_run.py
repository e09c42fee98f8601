"""A whole run: what it leaves, that it repeats bit for bit, and what the terminal says."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.files.table import read_columns
from cosim.simulation.workflow import run
from tests.warm import cosim

ROOT = Path(__file__).parent.parent


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(project: Path) -> None:
    scenario = project / "scenarios" / "regulate.yaml"
    bytes_of = {
        name: run(scenario, project / name, overrides, report=False).folder.joinpath("results.csv").read_bytes()
        for name, overrides in {"a": [], "b": [], "c": ["seed=2"]}.items()
    }
    assert bytes_of["a"] == bytes_of["b"]
    assert bytes_of["a"] != bytes_of["c"]


def test_a_manifest_repeats_its_run_bit_for_bit(project: Path) -> None:
    overrides = ["seed=5", "duration=3", "criteria={}", "components.plant.start.coulomb_friction.force=0.02"]
    first = run(project / "scenarios" / "manoeuvre.yaml", project / "first", overrides, report=False)
    again = run(first.folder / "manifest.json", project / "again", report=False)
    assert (first.folder / "results.csv").read_bytes() == (again.folder / "results.csv").read_bytes()
    assert again.manifest["scenario"] == first.manifest["scenario"]
    assert again.manifest["fmus"] == first.manifest["fmus"]


def test_a_manifest_is_not_repeated_with_another_fmu(project: Path) -> None:
    first = run(project / "scenarios" / "regulate.yaml", project / "first", report=False)
    plant = project / "build" / "plant.fmu"
    plant.write_bytes(plant.read_bytes() + b"\0")
    with pytest.raises(InputError, match="is not the FMU of this run"):
        run(first.folder / "manifest.json", project / "again", report=False)
    assert not (project / "again").exists()


def test_the_manifest_tells_what_the_run_was(project: Path) -> None:
    record = json.loads(
        (run(project / "scenarios" / "regulate.yaml", project / "o", report=False).folder / "manifest.json").read_text()
    )
    assert record["schema_version"] == 1
    assert record["seed"] == record["scenario"]["seed"] == 1
    assert record["scenario"]["algorithm"] == "gauss-seidel"
    for fmu in record["fmus"].values():
        assert re.fullmatch(r"[0-9a-f]{64}", fmu["sha256"])
        assert re.fullmatch(r"\{[0-9a-f]{32}\}", fmu["guid"])
    assert {"python", "fmpy", "numpy", "filterpy"} <= record["versions"].keys()
    assert all(c["met"] for c in record["criteria"])


def test_results_have_one_row_a_communication_point_and_read_back_bit_for_bit(project: Path) -> None:
    outcome = run(project / "scenarios" / "regulate.yaml", project / "o", report=False)
    back = read_columns(project / "o" / "results.csv")
    assert tuple(back.by_name) == ("time", *outcome.results.columns)
    assert back.rows == 501
    assert all((back[name] == outcome.results[name]).all() for name in outcome.results.columns)
    assert (back["time"] == outcome.results.time).all()


@pytest.mark.thorough
@pytest.mark.parametrize("scenario", ["regulate", "manoeuvre"])
@pytest.mark.parametrize("seed", [2, 3, 4, 5, 6])
def test_criteria_hold_for_any_seed(project: Path, scenario: str, seed: int) -> None:
    outcome = run(project / "scenarios" / f"{scenario}.yaml", project / "o", [f"seed={seed}"], report=False)
    assert not outcome.missed


def test_without_noise_the_regulator_settles_too(project: Path) -> None:
    assert not run(project / "scenarios" / "regulate.yaml", project / "o", ["noise=off"], report=False).missed


def test_the_manoeuvre_ends_where_it_began(project: Path) -> None:
    results = run(project / "scenarios" / "manoeuvre.yaml", project / "o", report=False).results
    # start and end pose of Appendix G coincide; the thesis allows 10 % of 1.5 m and 15 deg
    assert abs(results["plant.x_world"][-1]) < 0.15
    assert abs(results["plant.y_world"][-1]) < 0.15
    assert abs(results["plant.psi"][-1]) < 0.05
    # 1.5 m out to the right of the start, for the first turn is 90 deg to the right
    assert results["plant.y_world"].min() == pytest.approx(-1.5, abs=0.15)


@pytest.mark.thorough
def test_the_command_leaves_results_manifest_and_report(project: Path) -> None:
    done = cosim("run", "scenarios/regulate.yaml", "--out", "out", cwd=project)
    assert (done.returncode, done.stderr) == (0, "")
    assert "met: settling time of plant.x is" in done.stdout
    assert sorted(p.name for p in (project / "out").iterdir()) == ["manifest.json", "report.html", "results.csv"]


def test_bad_input_exits_2_without_traceback_and_writes_nothing(project: Path) -> None:
    for arguments in (
        ["run", "none.yaml"],
        ["run", "scenarios/regulate.yaml", "--set", "step=0.03"],
        ["check", "x.yaml"],
    ):
        done = cosim(*arguments, *(["--out", "out"] if arguments[0] == "run" else []), cwd=project)
        assert done.returncode == 2
        assert "Traceback" not in done.stderr
        assert ".yaml" in done.stderr
        assert not (project / "out").exists()


def test_a_file_that_is_no_fmu_exits_3(project: Path) -> None:
    (project / "build" / "plant.fmu").write_bytes(b"no zip")
    done = cosim("run", "scenarios/regulate.yaml", "--out", "out", cwd=project)
    assert done.returncode == 3
    assert cosim("check", "build/plant.fmu", cwd=project).returncode == 3
    assert not (project / "out").exists()


@pytest.mark.thorough  # the command builds in test_verbs, the fixtures build the FMUs
def test_build_makes_every_fmu_the_scenarios_name(tmp_path: Path) -> None:
    done = cosim("build", "--model", "hovercraft", "--out", "fmus", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    named = {
        name
        for file in (ROOT / "scenarios").glob("*.yaml")
        for name in re.findall(r"build/(\S+\.fmu)", file.read_text())
    }
    assert named <= {p.name for p in (tmp_path / "fmus").iterdir()}


def test_swapping_the_plant_keeps_the_scenario_running(project: Path) -> None:
    from cosim.fmi.fmu_build import build
    from fmus.recipes import HEAVY, plant_recipe

    build(plant_recipe(HEAVY), project / "build" / "plant-heavy.fmu")
    outcome = run(project / "scenarios" / "swap.yaml", project / "o", report=False)
    assert not outcome.missed
    assert (
        outcome.manifest["fmus"]["plant"]["guid"]
        != run(project / "scenarios" / "regulate.yaml", project / "p", report=False).manifest["fmus"]["plant"]["guid"]
    )


def test_a_duty_outside_the_fitted_thrust_line_is_warned_of_once(project: Path) -> None:
    # eq 4.20 was fitted on 6-7 %; beyond it is extrapolated
    path = project / "scenarios" / "duty.yaml"
    path.write_text(
        "name: duty\nduration: 0.2\nstep: 0.02\n"
        "components:\n  plant: {fmu: ../build/plant.fmu, start: {duty_right: 7.5}}\n"
    )
    warnings = [w for w in run(path, project / "o", report=False).manifest["warnings"] if "extrapolates" in w]
    assert len(warnings) == 1
    assert "at t = 0 s: duty 7.5 %" in warnings[0]


def test_a_run_without_a_report_leaves_none_of_other_results(project: Path) -> None:
    scenario, folder = project / "scenarios" / "regulate.yaml", project / "once"
    run(scenario, folder, ["duration=0.2"], report=True)
    assert (folder / "report.html").exists()
    run(scenario, folder, ["duration=0.2"], report=False, force=True)
    assert not (folder / "report.html").exists()
