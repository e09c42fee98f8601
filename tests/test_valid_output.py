"""The output `valid` of an FMU: the indicator of `cosim run`, computed in the FMU."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

import cosim
from cosim.credibility.bands import Bands
from cosim.credibility.found import content_hash, read_credibility
from cosim.credibility.record import Credibility, attach
from cosim.credibility.region import Region, Stretch, region_of
from cosim.fmi.wrapping.wrap import wrap
from tests.hosts_fmpy import Instance
from tests.logs import write_log
from tests.native import NEEDS_COMPILER
from tests.test_first_steps import told
from tests.wrapped import drive_fmu, terms_of

pytestmark = NEEDS_COMPILER
STEP = 0.02
KINDS = [(fmi, interface) for fmi in (2, 3) for interface in ("co-simulation", "model-exchange")]


def ran(
    folder: Path, fmu: Path, size: float, *, seed: int, interface: str = "co-simulation", step: float = STEP
) -> Any:
    """Run the drive for 12 s with a force [N] that jumps every 0.2 s, ten times as large between 5 s and 7 s."""
    rng = np.random.default_rng(seed)
    force = size * np.repeat(rng.uniform(-1.0, 1.0, 60), 10)
    force[250:350] *= 10.0 if seed else 1.0
    folder.mkdir(exist_ok=True)
    write_log(folder / "force.csv", {"time": STEP * np.arange(601), "force": np.append(force, force[-1:])})
    components = {
        "plant": {"fmu": str(fmu), "interface": interface},
        "played": {"block": "playback", "file": str(folder / "force.csv")},
    }
    content = {"name": "mission", "duration": 12, "step": step, "components": components}
    content["connections"] = [{"from": "played.force", "to": "plant.force"}]
    return cosim.run(content, in_process=True)


def with_record(folder: Path, fmi: int, region: Region) -> Path:
    """Return the drive with a record of this region."""
    fmu = Path(shutil.copy(drive_fmu(fmi), folder / "drive.fmu"))
    text = {"command": "cosim fit", "model": "Drive", "verdict": "improved", "sentence": "The error falls."}
    attach(fmu, Credibility(**text, logs=[], region=region, bands=Bands(reason="too few data")))
    return fmu


def read_record(fmu: Path) -> Credibility:
    record = read_credibility(fmu).record
    assert record is not None
    return record


def with_output(folder: Path, fmi: int, region: Region) -> Path:
    """Return the drive with the output `valid`."""
    told("build", "--valid-output", with_record(folder, fmi, region), "--out", folder / "build")
    return folder / "build" / "drive.fmu"


@pytest.fixture(scope="module")
def region(tmp_path_factory: pytest.TempPathFactory) -> Region:
    """The region of a run of the drive."""
    run = ran(tmp_path_factory.mktemp("region"), drive_fmu(2), 60.0, seed=0)
    signals = {name: run[f"plant.{name}"] for name in ("force", "position", "velocity")}
    return region_of([Stretch(run.time, signals)], ["force"], {"velocity": "m/s"}, STEP, {"position"})


def inside_of(run: Any) -> Any:
    """Return whether each row is inside by the manifest of the run."""
    outside = run.manifest["validity"]["plant"]["outside"]
    return ~np.any([(run.time >= begin - 1e-9) & (run.time < end - 1e-9) for begin, end in outside], axis=0)


@pytest.mark.parametrize(("fmi", "interface"), KINDS)
def test_it_equals_the_indicator_of_the_run_sample_by_sample(
    region: Region, tmp_path: Path, fmi: int, interface: str
) -> None:
    """A row tells about the step that ends there; the other outputs are those without it, to the last bit."""
    fmu = with_output(tmp_path, fmi, region)
    assert fmpy.validation.validate_fmu(str(fmu)) == []
    run, before = (ran(tmp_path, f, 60.0, seed=1, interface=interface) for f in (fmu, tmp_path / "drive.fmu"))
    valid, inside = run["plant.valid"] == 1.0, inside_of(run)
    assert valid[0]
    assert np.array_equal(valid[1:], inside[:-1])
    assert 0.3 < valid.mean() < 0.9
    assert run.manifest["validity"] == before.manifest["validity"]
    assert all(np.array_equal(run[f"plant.{n}"], before[f"plant.{n}"]) for n in ("position", "velocity"))


@pytest.mark.parametrize("interface", ["co-simulation", "model-exchange"])
def test_a_refined_fmu_has_it_too(region: Region, tmp_path: Path, interface: str) -> None:
    """Inputs are those of the host, before the lag that the refined FMU adds."""
    refined, fmu = tmp_path / "refined.fmu", with_record(tmp_path, 2, region)
    wrap(fmu, terms_of("lag"), {"lag_at_force.time": 0.05}, refined, substep=STEP)
    attach(refined, read_record(fmu))
    told("build", "--valid-output", refined, "--out", tmp_path / "build")
    run, before = (
        ran(tmp_path, f, 60.0, seed=1, interface=interface) for f in (tmp_path / "build/refined.fmu", refined)
    )
    assert np.array_equal((run["plant.valid"] == 1.0)[1:], inside_of(run)[:-1])
    assert np.array_equal(run["plant.velocity"], before["plant.velocity"])


@pytest.mark.parametrize(("step", "rows"), [(STEP / 2, 2), (STEP / 5, 5), (2 * STEP, 1)])
def test_with_another_step_it_tells_about_the_same_samples(
    region: Region, tmp_path: Path, step: float, rows: int
) -> None:
    """A sample lasts about a step of the logs; between its ends the value stays."""
    run = ran(tmp_path, with_output(tmp_path, 2, region), 60.0, seed=1, step=step)
    valid, inside = run["plant.valid"] == 1.0, inside_of(run)
    assert np.array_equal(valid[rows::rows], inside[:-rows:rows])
    assert np.array_equal(valid[rows:-1].reshape(-1, rows), np.repeat(valid[rows:-1:rows, None], rows, axis=1))
    assert 0.3 < valid.mean() < 0.9


def test_a_saved_state_holds_it(region: Region, tmp_path: Path) -> None:
    forces = np.repeat([10.0, 600.0, -10.0], [10, 8, 82])

    def steps(plant: Instance, first: int, last: int) -> list[bool]:
        found = []
        for k in range(first, last):
            plant.set({"force": forces[k]})
            plant.call("doStep", k * STEP, STEP)
            found += plant.get(["valid"])
        return found

    with Instance(with_output(tmp_path, 2, region)) as plant:
        plant.initialize()
        early = steps(plant, 0, 15)
        data = plant.serialized()
        late = steps(plant, 15, 100)
        plant.restore(data)
        assert steps(plant, 15, 100) == late
        plant.call("reset")
        plant.initialize()
        assert plant.get(["valid"]) == [True]
        assert steps(plant, 0, 100) == early + late
        assert {*early} == {*late} == {False, True}


@pytest.mark.parametrize("fmi", [2, 3])
def test_it_follows_inputs_as_the_outputs_whose_rates_are_judged(region: Region, tmp_path: Path, fmi: int) -> None:
    about = fmpy.read_model_description(str(with_output(tmp_path, fmi, region)))
    dependencies = {u.variable.name: [v.name for v in u.dependencies] for u in about.outputs}
    (valid,) = [v for v in about.modelVariables if v.name == "valid"]
    assert dependencies["valid"] == dependencies["velocity"]
    assert (valid.type, valid.causality, valid.variability, valid.start) == ("Boolean", "output", "discrete", "true")
    assert not any(u.variable.name == "valid" for u in about.initialUnknowns)


def test_without_a_region_it_is_false(tmp_path: Path) -> None:
    run = ran(tmp_path, with_output(tmp_path, 2, Region(reason="too few data")), 60.0, seed=1)
    assert not run["plant.valid"].any()


def test_the_fmu_keeps_its_record(region: Region, tmp_path: Path) -> None:
    fmu = with_output(tmp_path, 2, region)
    assert read_record(fmu) == read_record(tmp_path / "drive.fmu")
    assert read_credibility(fmu).problem == ""
    assert content_hash(fmu) != content_hash(tmp_path / "drive.fmu")


# -- bad input -----------------------------------------------------------------------------------------


def refused(folder: Path, fmu: Path, *options: str) -> None:
    told("build", "--valid-output", fmu, "--out", folder / "never", *options, code=2)
    assert not (folder / "never").exists()


def test_an_fmu_without_a_record_is_refused(tmp_path: Path) -> None:
    refused(tmp_path, drive_fmu(2))
    refused(tmp_path, tmp_path / "none.fmu")


def test_a_taken_name_is_refused(region: Region, tmp_path: Path) -> None:
    refused(tmp_path, with_output(tmp_path, 2, region))


def test_a_changed_fmu_is_refused(region: Region, tmp_path: Path) -> None:
    fmu = with_record(tmp_path, 2, region)
    with zipfile.ZipFile(fmu, "a") as archive:
        archive.writestr("documentation/more.txt", "later")
    refused(tmp_path, fmu)


def test_a_region_of_other_variables_is_refused(region: Region, tmp_path: Path) -> None:
    other = region.model_copy(deep=True)
    other.coordinates[0].signal = "thrust"
    refused(tmp_path, with_record(tmp_path, 2, other))


@pytest.mark.parametrize("options", [("--model", "hovercraft"), ("--native",), ("--design", "design.yaml")])
def test_it_is_no_option_of_a_models_fmus(region: Region, tmp_path: Path, options: tuple[str, ...]) -> None:
    refused(tmp_path, with_record(tmp_path, 2, region), *options)


def test_the_fmu_itself_is_not_replaced(region: Region, tmp_path: Path) -> None:
    fmu = with_record(tmp_path, 2, region)
    before = fmu.read_bytes()
    told("build", "--valid-output", fmu, "--out", tmp_path, code=2)
    assert fmu.read_bytes() == before
