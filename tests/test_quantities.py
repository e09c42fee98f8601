"""Units as people write them, in every file, in options and from Python; differences of temperatures have no offset."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import cosim
from cosim.blocks.component import Signal
from cosim.core.errors import InputError
from cosim.core.units import parse, read_quantity, square_unit
from cosim.fmi.building.file import read_model
from cosim.logs.log import read_log
from cosim.refinement.study import StudyFile, read_study
from cosim.scenario.scenario_file import ScenarioFile
from cosim.sweeps.reading import read_sweep
from cosim.verbs.cli import command_line
from tests.typed import typed_fmu

TANK = """
from dataclasses import dataclass
from cosim.model import Equations, Model, Quantity, parameter


@dataclass(frozen=True, kw_only=True)
class Tank(Model):
    \"\"\"A tank of water that is heated.\"\"\"

    title = "Tank"
    base_states = (Quantity("T", "K", "temperature", 293.15),)
    inputs = (Quantity("power", "W", "heating"),)
    outputs = base_states
    sensor_variance = {"T": 0.01}
    forced = ("T",)
    rate, substep, horizon = 0.1, 0.1, 10.0
    mass: float = parameter(400.0, unit="kg", bounds=(1, 1e4), doc="of the water")
    ambient: float = parameter(293.15, unit="K", bounds=(200, 400), doc="around it")

    def equations(self, m):
        def derivative(t, state, command):
            return ((command[0] - 10.0 * (state[0] - self.ambient)) / (4186.0 * self.mass),)

        def output(t, state, command):
            return state

        return Equations(derivative, output)
"""


# -- what a unit is --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("4 min", "s", 240.0), ("20ms", "s", 0.02), ("400 kg", "kg", 400.0), ("0.4 t", "kg", 400.0),
        ("-15 degC", "K", 258.15),
        ("-15 °C", "K", 258.15), ("-15℃", "K", 258.15), ("-40 degF", "degC", -40.0), ("300 K", "degC", 26.85),
        ("1e-6 m", "mm", 1e-3), ("1e-6", "m", 1e-6), ("3 1/min", "1/s", 0.05), ("12 deg", "rad", math.radians(12)),
        ("5 %", "1", 0.05), ("5 %", "%", 5.0), ("2 W/degC", "W/K", 2.0),
    ],
)  # fmt: skip
def test_a_quantity_is_its_number_in_the_unit_that_is_wanted(text: str, unit: str, value: float) -> None:
    assert read_quantity(text, unit) == pytest.approx(value, rel=1e-14, abs=1e-12)  # a rounding or two


@pytest.mark.parametrize(
    ("text", "unit", "said"),
    [
        ("4 furlong", "s", "it is a number [s], or text with a unit: 3 s, 3 ms"),
        ("4 kg", "s", "it is a number [s], or text with a unit"),
        ("ten", "s", "it is a number [s]"),
        ("4 kg", "", "it is a number alone: no unit of it is declared"),
        ("1e999 s", "s", "it is not finite"),
    ],
)
def test_what_is_no_such_quantity_is_told_with_what_is_allowed(text: str, unit: str, said: str) -> None:
    with pytest.raises(ValueError, match=said.replace("[", r"\[").replace("]", r"\]")):
        read_quantity(text, unit)


def test_the_square_of_a_unit_has_its_exponents_twice() -> None:
    for unit in ("rad", "m/s2", "N.m.s/rad", "deg/s"):
        once, twice = parse(unit), parse(square_unit(unit))
        assert once is not None
        assert twice is not None
        assert twice.exponents == {name: 2 * power for name, power in once.exponents.items()}
        assert twice.factor == pytest.approx(once.factor**2, rel=1e-15)


# -- scenarios, --set and Python -------------------------------------------------------------------


def heated(folder: Path, **more: Any) -> Path:
    """A scenario with a reference in degC that nothing takes, and an FMU."""
    typed_fmu(folder)
    content: dict[str, Any] = {
        "name": "s", "duration": "1 min", "step": "500 ms", "start_time": "1 h",
        "components": {
            "a": {"fmu": "typed.fmu"},
            "r": {"block": "reference", "signals": {
                "T": {"unit": "degC", "start": "300 K",
                      "changes": [{"at": "0.5 min", "to": "80 degF", "rate": "6 K/min"}]},
                "phi": {"unit": "deg", "start": "0.5 rad"},
            }},
        },
        **more,
    }  # fmt: skip
    path = folder / "s.json"
    path.write_text(json.dumps(content))
    return path


def test_times_and_references_of_a_scenario_may_be_written_with_units(tmp_path: Path) -> None:
    file = ScenarioFile(heated(tmp_path))
    assert file.faults == []
    s = file.scenario
    assert (s.duration, s.step, s.start_time) == (60.0, 0.5, 3600.0)
    reference: Any = s.components["r"]
    warm, phi = reference.signals["T"], reference.signals["phi"]
    assert warm.start == pytest.approx(26.85)
    assert warm.changes[0].at == 30.0
    assert warm.changes[0].to == pytest.approx(80 / 1.8 - 32 / 1.8)
    assert warm.changes[0].rate == pytest.approx(0.1)
    assert phi.start == pytest.approx(math.degrees(0.5))


def test_noise_and_faults_are_in_the_unit_of_the_input_and_differences(tmp_path: Path) -> None:
    craft = {"block": "fix", "rate": "60 1/min", "latency": "20 ms", "dropout": "5 %",
             "signals": {"T": {"unit": "K", "noise": {"bias": "2 degC", "variance": "9 degC2"}}}}  # fmt: skip
    path = heated(tmp_path)
    content = json.loads(path.read_text())
    content["components"]["f"] = craft
    content["connections"] = [{"from": "r.T", "to": "f.T", "noise": {"bias": "1.8 degF", "variance": "4 K2"}}]
    content["faults"] = [
        {"on": "f.T", "kind": "bias", "value": "3 degC", "from": "1 min", "to": "2 min"},
        {"on": "f.T", "kind": "stuck", "value": "20 degC"},
        {"on": "f.T", "kind": "dropout", "probability": "50 %"},
        {"on": "f.T", "kind": "delay", "delay": "1500 ms"},
    ]
    content["criteria"] = {
        "peak": {"of": "f.T", "max": "80 degC", "after": "10 s"},
        "rms_error": {"of": "f.T", "to": "25 degC", "max": "2 degC"},
        "settling_time": {"of": "f.T", "to": 300, "band": "0.5 degC", "max": "0.5 min"},
    }
    path.write_text(json.dumps(content))
    file = ScenarioFile(path)
    assert file.faults == []
    s = file.scenario
    fix: Any = s.components["f"]
    assert (fix.rate, fix.latency, fix.dropout) == pytest.approx((1.0, 0.02, 0.05))
    assert (fix.signals["T"].noise.bias, fix.signals["T"].noise.variance) == (2.0, 9.0)
    noise = s.connections[0].noise
    assert noise is not None
    assert (noise.bias, noise.variance) == pytest.approx((1.0, 4.0))
    assert [f.value for f in s.faults[:2]] == pytest.approx([3.0, 293.15])
    assert (s.faults[0].begin, s.faults[0].end, s.faults[2].probability, s.faults[3].delay) == (60.0, 120.0, 0.5, 1.5)
    limits = {kind: c for kind, _, c in s.goals}
    assert limits["peak"].max == pytest.approx(353.15)
    assert (limits["rms_error"].to, limits["rms_error"].max) == pytest.approx((298.15, 2.0))
    assert (limits["settling_time"].band, limits["settling_time"].max) == (0.5, 30.0)


def test_a_reference_in_degrees_celsius_reaches_an_input_in_kelvin(tmp_path: Path) -> None:
    path = heated(tmp_path)
    content = json.loads(path.read_text())
    content["duration"], content["start_time"] = "5 s", 0
    content["components"]["f"] = {"block": "fix", "rate": 1, "signals": {"T": {"unit": "K"}}}
    content["connections"] = [{"from": "r.T", "to": "f.T"}]
    path.write_text(json.dumps(content))
    made = cosim.run(path, in_process=True, report=False)
    assert made["r.T"][0] == pytest.approx(26.85)
    assert made["f.T"][-1] == pytest.approx(300.0, rel=1e-15)


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("duration", "4 kg", "duration is '4 kg': it is a number [s], or text with a unit: 3 s, 3 ms"),
        ("duration", "-4 min", "it should be greater than 0"),
        ("criteria", {"peak": {"of": "r.T", "max": "4 kg"}},
         "criteria.peak.max is '4 kg': it is a number [degC], or text with a unit: 3 degC"),
        ("criteria", {"peak": {"of": "r.none", "max": "4 kg"}}, "the unit of r.none is not known"),
        ("criteria", {"settling_time": {"of": "r.T", "max": "1 s", "band": "-2 K"}},
         "criteria.settling_time.band is -2.0: it should be greater than 0"),
    ],
)  # fmt: skip
def test_a_unit_that_does_not_fit_is_a_fault_with_its_place(tmp_path: Path, key: str, value: Any, fault: str) -> None:
    path = heated(tmp_path, **{key: value})
    (found,) = [f for f in ScenarioFile(path).faults if fault in f.message]
    assert found.line == 1
    assert found.column > 1


def test_faults_of_form_of_units_and_of_ranges_come_at_once(tmp_path: Path) -> None:
    connections = [{"to": "f.T"}, {"from": "r.T", "to": "f.T", "offset": "3 m", "noise": {"variance": "-9 K2"}}]
    path = heated(tmp_path, step="2 kg", connections=connections, faults=[{"on": "f.T", "kind": "stuck", "value": "x"}])
    content = json.loads(path.read_text())
    content["components"]["f"] = {"block": "fix", "rate": 1, "signals": {"T": {"unit": "K"}}}
    path.write_text(json.dumps(content))
    faults = " ".join(f.message for f in ScenarioFile(path).faults)
    parts = (
        "connections.0.from",
        "connections.1.offset is '3 m'",
        "connections.1.noise.variance is -9",
        "faults.0.value",
    )
    assert all(part in faults for part in (*parts, "step is '2 kg'")), faults


def test_units_are_taken_from_set_and_from_python(tmp_path: Path) -> None:
    path = heated(tmp_path)
    file = ScenarioFile(path, ["duration=4 min", "step=20ms", "components.r.signals.T.start=0 degC"])
    assert (file.scenario.duration, file.scenario.step) == (240.0, 0.02)
    assert file.scenario.components["r"].signals["T"].start == 0.0  # type: ignore[union-attr]
    made = cosim.run(path, set={"duration": "2 s", "start_time": 0}, in_process=True, report=False)
    assert made.time[-1] == 2.0
    words = f"simulate {tmp_path}/typed.fmu --stop 200ms --in-process --no-report --out {tmp_path}/out --step"
    done = CliRunner().invoke(command_line(), [*words.split(), "0.1 s"])
    assert done.exit_code == 0, done.output
    assert cosim.read(tmp_path / "out").time[-1] == pytest.approx(0.2)  # type: ignore[union-attr]


# -- logs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "scale", "offset"), [("degC", 1.0, 273.15), ("degF", 5 / 9, 459.67 * 5 / 9)])
def test_a_column_in_degrees_is_converted_to_kelvin(tmp_path: Path, unit: str, scale: float, offset: float) -> None:
    (tmp_path / "a.csv").write_text(f"time,power [kW],T [{unit}]\n" + "".join(f"{k},1,{k}\n" for k in range(9)))
    log = read_log(tmp_path / "a.csv", [Signal("power", "W")], [Signal("T", "K")])
    assert log.outputs["T"] == pytest.approx(scale * np.arange(9) + offset, rel=1e-15)
    assert log.inputs["power"][0] == 1000.0


# -- models, studies, sweeps, protocols ------------------------------------------------------------


def test_parameters_of_a_model_file_are_converted(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(TANK)
    path = tmp_path / "model.yaml"
    path.write_text("model: tank.py:Tank\nparameters: {mass: 0.5 t, ambient: -15 degC}\n")
    assert read_model(path).parameters == pytest.approx({"mass": 500.0, "ambient": 258.15})
    path.write_text("model: tank.py:Tank\nparameters:\n  mass: 5 m\n  ambient: 900 degC\n  masss: 4 kg\n")
    with pytest.raises(InputError) as refused:
        read_model(path)
    told = str(refused.value)
    assert "model.yaml:3:9: parameters.mass is '5 m': it is a number [kg], or text with a unit: 3 kg, 3 g" in told
    assert "model.yaml:4:12: ambient is 1173.15; it lies in [200, 400] K" in told
    assert 'model.yaml:5:3: tank.py:Tank has no parameter "masss"; did you mean "mass"?' in told


def test_noise_and_tolerances_of_a_study_are_differences_and_shares(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(TANK)
    rows = "".join(f"{k / 10},{1000 * (k // 40 % 2)},{20 + k % 3 / 10}\n" for k in range(900))
    (tmp_path / "a.csv").write_text(f"time,power,T [degC]\n{rows}")
    path = tmp_path / "study.yaml"
    text = "model: tank.py:Tank\nlogs: {estimation: [a.csv]}\nnoise: {T: 0.18 degF}\ntolerance: {mass: 10 %}\n"
    path.write_text(text)
    study = read_study(path)
    assert study.content.noise == pytest.approx({"T": 0.1})
    assert study.content.tolerance == pytest.approx({"mass": 0.1})
    assert study.logs[0].outputs["T"][0] == pytest.approx(293.15)
    for noise, reason in (
        ("0.1 m", r"'0.1 m': it is a number \[K\]"),
        ("-0.9 degF", "-0.5: it should be greater than 0"),
    ):
        path.write_text(text.replace("0.18 degF", noise))
        with pytest.raises(InputError, match=f"study.yaml:3:12: noise.T is {reason}"):
            read_study(path)
    assert StudyFile.model_json_schema()["properties"]["noise"]["additionalProperties"]["type"] == ["number", "string"]


def test_distributions_of_a_sweep_may_be_written_with_units(tmp_path: Path) -> None:
    heated(tmp_path, start_time=0)
    (tmp_path / "sweep.yaml").write_text(
        "scenario: s.json\nruns: 50\nsignals: [r.T]\nset: {duration: 2 s}\nvary:\n"
        "  components.r.signals.T.start: {uniform: [0 degC, 300 K]}\n"
        "  components.r.signals.phi.start: {normal: [10 deg, 0.001 rad]}\n"
    )
    sweep = read_sweep(tmp_path / "sweep.yaml")
    warm = np.array(sweep.columns["components.r.signals.T.start"])
    assert 0.0 <= warm.min() < 2.0 < 25.0 < warm.max() <= 26.85
    phi = np.array(sweep.columns["components.r.signals.phi.start"])
    assert phi.mean() == pytest.approx(10.0, abs=0.02)
    assert phi.std() == pytest.approx(math.degrees(0.001), rel=0.3)  # of 50 draws
    assert sweep.scenario.duration == 2.0
