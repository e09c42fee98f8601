"""Pages and the terminal show values in the display unit of the FMU or of the scenario; files keep declared units."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from starlette.requests import Request

import cosim
from cosim.core.errors import InputError
from cosim.core.text import amount, display, showing
from cosim.pages.runs import find_runs, open_runs
from cosim.pages.view_page import Viewer
from cosim.simulation.run_signals import Run
from tests.test_first_steps import told

SCENARIO = """
name: warming
duration: 2
step: 1
display: {K: degC, m: mm}
components:
  log: {block: playback, file: log.csv}
criteria:
  final_error: {of: log.x, to: 1.0, max: 0.6}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "log.csv").write_text("time,T [K],x [m]\n0,280,0\n1,290,0.25\n2,300,0.5\n", encoding="utf-8")
    (tmp_path / "warming.yaml").write_text(SCENARIO, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_scenario_chooses_the_units_of_terminal_report_and_browser(folder: Path) -> None:
    assert "500 mm" in told("run", "warming.yaml", "--out", "out").replace("\u00a0", " ")
    manifest = json.loads((folder / "out" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["display"] == {"K": ["degC", 1.0, -273.15], "m": ["mm", 1000.0, 0.0]}
    assert manifest["units"] == {"log.T": "K", "log.x": "m"}
    assert manifest["criteria"][0]["value"] == 0.5
    read = cosim.read(folder / "out")
    assert isinstance(read, Run)
    np.testing.assert_array_equal(read["log.T"], [280.0, 290.0, 300.0])
    assert "500\u00a0mm" in (folder / "out" / "report.html").read_text(encoding="utf-8")
    runs, _ = open_runs(find_runs(["out"], folder)[0])
    viewer, request = Viewer(runs, None), Request({"type": "http"})
    about = json.loads(bytes(viewer.routes()["GET /about"](request, None).body))
    assert [about["runs"][0][key] for key in ("numbers", "units")] == [["log.T", "log.x"], ["°C", "mm"]]
    values = viewer.routes()["POST /values"](request, {"curves": [[0, "log.T"]], "at": 1.0}).body
    assert struct.unpack("<2d", bytes(values)) == pytest.approx((1.0, 290.0 - 273.15))


def test_an_fmu_brings_its_display_units(folder: Path, plant_fmu: Path) -> None:
    made = cosim.simulate(plant_fmu, stop=0.1, step=0.02)
    name, factor, offset = made.manifest["display"]["rad"]
    assert (name, offset) == ("deg", 0.0)
    assert factor == pytest.approx(180.0 / math.pi)


@pytest.mark.parametrize("unit", ["m: s", "m: ''", "nobody: m"])
def test_a_unit_that_shows_nothing_is_a_fault_with_its_place(folder: Path, unit: str) -> None:
    (folder / "warming.yaml").write_text(SCENARIO.replace("K: degC, m: mm", unit), encoding="utf-8")
    with pytest.raises(InputError) as error:
        cosim.run("warming.yaml")
    assert error.value.exit_code == 2
    assert [fault.line for fault in error.value.faults] == [5]


def test_differences_have_no_zero_and_damaged_display_units_are_passed_over() -> None:
    shown = {"display": {"K": ["degC", 1.0, -273.15], "rad": ["deg", 180.0 / math.pi, 0.0]}}
    with showing(shown):
        assert amount(300.0, "K", 4) == "26.85\u00a0°C"
        assert amount(3.0, "K", 2, difference=True) == "3.0\u00a0K"
        assert amount(math.pi, "rad", 4) == "180.0°"
    for damaged in (["deg", None, 0.0], ["deg", 57.3], [1.0, 57.3, 0.0], ["deg", float("nan"), 0.0], "deg"):
        with showing({"display": {"rad": damaged}}):
            assert display("rad") == ("rad", 1.0)
