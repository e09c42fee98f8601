"""FMUs of the examples, compiled here, and what `cosim refine` finds on measured logs without their equations.

Recordings are not part of the project; tests that need them look where `tests/test_examples_data.py` does, and skip
without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.fmi.native.compiler import NoCompiler
from cosim.refinement.workflow import refine
from tests.hosts_fmpy import Instance
from tests.test_examples_data import EXAMPLES, _loaded, data_of
from tests.test_examples_data import columns as columns_of

FMUS = ("drive", "silverbox", "incubator", "coupled_drives")


def compiled(example: str, folder: Path) -> Path:
    """Return the FMU of an example; skip without a compiler."""
    build = _loaded(EXAMPLES / "compiled_fmu.py")
    try:
        return Path(build.compiled_fmu(EXAMPLES / example / "fmu", folder / f"{example}.fmu"))
    except NoCompiler as error:
        pytest.skip(str(error))


def script_of(example: str) -> Any:
    return _loaded(EXAMPLES / example / "make_logs.py")


def studies_of(example: str, files: Sequence[str], folder: Path) -> Any:
    """Return the studies of an example with an FMU; skip without compiler or recordings."""
    compiled(example, folder)
    return script_of(example).make_logs(data_of(example, files), folder)


@pytest.mark.parametrize("example", FMUS)
def test_the_fmu_of_an_example_is_valid_and_holds_no_source(example: str, tmp_path: Path) -> None:
    import zipfile

    from fmpy.validation import validate_fmu

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


# -- on the recordings --------------------------------------------------------------------------


def test_the_published_values_of_the_incubator_leave_the_published_error(tmp_path: Path) -> None:
    script, published = script_of("incubator"), _loaded(EXAMPLES / "incubator" / "published.py")
    data = data_of("incubator", [r.name for r in vars(script).values() if type(r).__name__ == "Recording"])
    compiled("incubator", tmp_path)
    script.make_logs(data, tmp_path)
    whole = published.whole_of_2023(tmp_path)

    def error(model: Any, values: tuple[float, ...]) -> float:
        return float(np.sqrt(np.mean((model(whole, *values) - whole[3]) ** 2)))

    assert error(published.four, published.FOUR["2023"]) == pytest.approx(0.459, abs=2e-3)
    assert error(published.two, published.TWO["2023"]) == pytest.approx(0.858, abs=2e-3)


def test_the_speed_of_the_coupled_drives_never_reads_below_zero(tmp_path: Path) -> None:
    study = studies_of("coupled_drives", ["drive.mat"], tmp_path)
    log = columns_of(study.parent / "e1.csv")
    assert len(log["speed"]) == 340
    assert log["speed"].min() > 0.0
    assert {*np.sign(log["voltage"])} == {-1.0, 1.0}


@pytest.mark.thorough
def test_the_emps_fmu_lacks_an_offset_and_dry_friction(tmp_path: Path) -> None:
    script = script_of("drive")
    script.make_logs(data_of("drive", ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"]), tmp_path)
    compiled("drive", tmp_path)
    record = refine(script.write_fmu_study(tmp_path), tmp_path / "out").record
    names = {e["name"] for e in record["effects"]} | {*record["nearest"]}
    assert {"coulomb_at_velocity", "bias_at_force"} <= names, record["sentence"]


@pytest.mark.thorough
def test_the_coupled_drives_show_the_magnitude_of_their_speed(tmp_path: Path) -> None:
    record = refine(studies_of("coupled_drives", ["drive.mat"], tmp_path), tmp_path / "out").record
    names = {e["name"] for e in record["effects"]} | {*record["nearest"]}
    assert "magnitude_at_speed" in names, record["sentence"]


@pytest.mark.thorough
def test_the_heated_box_lacks_a_lag_of_its_heater(tmp_path: Path) -> None:
    script = script_of("incubator")
    data = data_of("incubator", [r.name for r in vars(script).values() if type(r).__name__ == "Recording"])
    compiled("incubator", tmp_path)
    _, study = script.make_logs(data, tmp_path)
    record = refine(study, tmp_path / "out").record
    hypotheses = [*(r.split(" + ") for r in record["rivals"]), record["nearest"]]
    assert all({"lag_at_power", "second_order_lag_at_power"} & {*names} for names in hypotheses), record["sentence"]


@pytest.mark.thorough
def test_the_silverbox_fmu_lacks_a_cubic_spring(tmp_path: Path) -> None:
    """A part of the rows and few candidates; the whole study takes minutes."""
    script = script_of("silverbox")
    script.make_logs(data_of("silverbox", ["SNLS80mV.csv"], {"SNLS80mV.csv": ["snls80mv.csv"]}), tmp_path)
    compiled("silverbox", tmp_path)
    study = script.write_fmu_study(tmp_path)
    for name, rows in (("multisine.csv", 3_000), ("arrow.csv", 12_000)):
        lines = (tmp_path / name).read_text().splitlines(keepends=True)
        (tmp_path / name).write_text("".join(lines[: rows + 1]))
    named = ["bias_at_V1", "gain_at_V1", "dead_band_at_V1", "cubic_spring_at_rate", "viscous_at_rate"]
    study.write_text(f"{study.read_text()}candidates: {named}\n")
    record = refine(study, tmp_path / "out").record
    assert {e["name"] for e in record["effects"]} == {"bias_at_V1", "gain_at_V1", "cubic_spring_at_rate"}
