"""FMUs of the examples, compiled here, and what `cosim refine` finds on measured logs without their equations.

Recordings are not part of the project; tests that need them look where `tests/test_examples_data.py` does, and skip
without them.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu

from cosim.fmi.native.compiler import NoCompiler
from cosim.refinement.workflow import refine
from tests.hosts_fmpy import Instance
from tests.test_examples_data import EXAMPLES, _loaded, data_of


def compiled(example: str, folder: Path) -> Path:
    """Return the FMU of an example; skip without a compiler."""
    build = _loaded(EXAMPLES / "compiled_fmu.py")
    try:
        return Path(build.compiled_fmu(EXAMPLES / example / "fmu", folder / f"{example}.fmu"))
    except NoCompiler as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("example", ["drive", "silverbox", "incubator", "coupled_drives"])
def test_the_fmu_of_an_example_is_valid_and_holds_no_source(example: str, tmp_path: Path) -> None:
    fmu = compiled(example, tmp_path)
    assert validate_fmu(str(fmu)) == []
    with zipfile.ZipFile(fmu) as archive:
        assert not [name for name in archive.namelist() if name.endswith(".c")]


def test_the_drive_follows_its_equation(tmp_path: Path) -> None:
    with Instance(compiled("drive", tmp_path)) as fmu:
        fmu.initialize()
        for k in range(100):
            outputs = fmu.step(k * 0.01, 0.01, {"force": 20.0})
    decay = np.exp(-200.0 / 95.0)  # after 1 s
    assert outputs["velocity"] == pytest.approx(0.1 * (1.0 - decay), rel=1e-9)
    assert outputs["position"] == pytest.approx(0.1 * (1.0 - 95.0 / 200.0 * (1.0 - decay)), rel=1e-9)


def test_the_box_comes_to_rest_where_loss_is_power(tmp_path: Path) -> None:
    with Instance(compiled("incubator", tmp_path)) as fmu:
        fmu.initialize({"G_box": 0.6, "C_air": 200.0})
        for k in range(400):
            outputs = fmu.step(k * 10.0, 10.0, {"power": 18.0})
    assert outputs["T"] == pytest.approx(295.0 + 18.0 / 0.6, abs=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("example", "files", "missing"),
    [
        ("drive", ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"], {"coulomb_at_velocity", "bias_at_force"}),
        ("coupled_drives", ["drive.mat"], {"magnitude_at_speed"}),  # which never reads below zero
        ("incubator", [], {"lag_at_power", "second_order_lag_at_power"}),  # one of them
    ],
)
def test_an_fmu_lacks_what_recordings_show(example: str, files: list[str], missing: set[str], tmp_path: Path) -> None:
    script = _loaded(EXAMPLES / example / "make_logs.py")
    names = files or [r.name for r in vars(script).values() if type(r).__name__ == "Recording"]
    compiled(example, tmp_path)
    study = script.make_logs(data_of(example, names), tmp_path)
    if example == "drive":
        study = script.write_fmu_study(tmp_path)
    elif example == "incubator":
        study = study[1]
    record = refine(study, tmp_path / "out").record
    hypotheses = [*(rival.split(" + ") for rival in record["rivals"]), record["nearest"]]
    if example == "incubator":
        assert all(missing & {*names} for names in hypotheses), record["sentence"]
    else:
        assert missing <= {e["name"] for e in record["effects"]} | {*record["nearest"]}, record["sentence"]
