"""Units as people write them, in every file, in options and from Python; differences of temperatures have no offset."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.core.units import read_quantity
from cosim.fmi.building.file import read_model
from cosim.refinement.study import read_study
from cosim.scenario.scenario_file import ScenarioFile
from cosim.sweeps.reading import read_sweep
from tests.test_first_steps import told
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

        return Equations(derivative, lambda t, state, command: state)
"""


# -- what a unit is --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("20ms", "s", 0.02), ("0.4 t", "kg", 400.0), ("-15℃", "K", 258.15), ("-40 degF", "degC", -40.0),
        ("300 K", "degC", 26.85), ("1e-6 m", "mm", 1e-3), ("1e-6", "m", 1e-6), ("3 1/min", "1/s", 0.05),
        ("12 deg", "rad", math.radians(12)), ("5 %", "1", 0.05), ("5 %", "%", 5.0), ("2 W/degC", "W/K", 2.0),
    ],
)  # fmt: skip
def test_a_quantity_is_its_number_in_the_unit_that_is_wanted(text: str, unit: str, value: float) -> None:
    assert read_quantity(text, unit) == pytest.approx(value, rel=1e-14, abs=1e-12)  # a rounding or two


@pytest.mark.parametrize(
    ("text", "unit", "said"),
    [
        ("4 furlong", "s", "text with a unit: 3 s, 3 ms"), ("4 kg", "s", "text with a unit"),
        ("ten", "s", r"a number \[s\]"), ("4 kg", "", "a number without a unit"), ("1e999 s", "s", "it is not finite"),
    ],
)  # fmt: skip
def test_what_is_no_such_quantity_is_told_with_what_is_allowed(text: str, unit: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        read_quantity(text, unit)


# -- scenarios, --set and Python -------------------------------------------------------------------


HEATED = """name: s
duration: 1 min
step: 500 ms
start_time: 1 h
components:
  a: {fmu: typed.fmu}
  r:
    block: reference
    signals:
      T: {unit: degC, start: 300 K, changes: [{at: 0.5 min, to: 80 degF, rate: 6 K/min}]}
      phi: {unit: deg, start: 0.5 rad}
"""
FIX = "  f: {block: fix, rate: 1, signals: {T: {unit: K}}}\n"


def heated(folder: Path, more: str = "") -> Path:
    """A scenario with a reference in degC that nothing takes, and an FMU."""
    typed_fmu(folder)
    (folder / "s.yaml").write_text(HEATED + more)
    return folder / "s.yaml"


def test_times_and_references_of_a_scenario_may_be_written_with_units(tmp_path: Path) -> None:
    s: Any = ScenarioFile(heated(tmp_path)).scenario
    warm, phi = s.components["r"].signals["T"], s.components["r"].signals["phi"]
    (change,) = warm.changes
    found = s.duration, s.step, s.start_time, warm.start, change.at, change.to, change.rate, phi.start
    assert found == pytest.approx((60, 0.5, 3600, 26.85, 30, 80 / 1.8 - 32 / 1.8, 0.1, math.degrees(0.5)))


INPUT_UNITS = """  f:
    block: fix
    rate: 60 1/min
    latency: 20 ms
    dropout: 5 %
    signals: {T: {unit: K, noise: {bias: 2 degC, variance: 9 degC2}}}
connections: [{from: r.T, to: f.T, noise: {bias: 1.8 degF, variance: 4 K2}}]
faults:
- {on: f.T, kind: bias, value: 3 degC, from: 1 min, to: 2 min}
- {on: f.T, kind: stuck, value: 20 degC}
- {on: f.T, kind: dropout, probability: 50 %}
- {on: f.T, kind: delay, delay: 1500 ms}
criteria:
  peak: {of: f.T, max: 80 degC, after: 10 s}
  rms_error: {of: f.T, to: 25 degC, max: 2 degC}
  settling_time: {of: f.T, to: 300, band: 0.5 degC, max: 0.5 min}
"""


def test_noise_and_faults_are_in_the_unit_of_the_input_and_differences(tmp_path: Path) -> None:
    s: Any = ScenarioFile(heated(tmp_path, INPUT_UNITS)).scenario
    fix, noise = s.components["f"], s.connections[0].noise
    own = fix.signals["T"].noise
    assert (fix.rate, fix.latency, fix.dropout, own.bias, own.variance) == pytest.approx((1, 0.02, 0.05, 2, 9))
    bias, stuck, dropout, delay = s.faults
    assert (noise.bias, noise.variance, bias.value, stuck.value) == pytest.approx((1.0, 4.0, 3.0, 293.15))
    assert (bias.begin, bias.end, dropout.probability, delay.delay) == (60.0, 120.0, 0.5, 1.5)
    peak, rms, settling = (criterion for _, _, criterion in s.goals)
    assert (peak.max, rms.to, rms.max) == pytest.approx((353.15, 298.15, 2.0))
    assert (peak.after, settling.band, settling.max) == (10.0, 0.5, 30.0)


@pytest.mark.parametrize(
    ("old", "new", "line", "fault"),
    [
        ("duration: 1 min", "duration: 4 kg", 2, "duration is '4 kg'"),
        ("duration: 1 min", "duration: -4 min", 2, "it should be greater than 0"),
        ("step: 500 ms", "step: 2 kg", 3, "step is '2 kg'"),
        ("f.T, max: 80 degC", "f.T, max: 4 kg", 25, "criteria.peak.max is '4 kg': "),
        ("f.T, max: 80 degC", "r.none, max: 4 kg", 25, "the unit of r.none is unknown"),
        ("band: 0.5 degC", "band: -2 K", 27, "criteria.settling_time.band is -2.0: it should be greater than 0"),
        ("to: f.T, noise", "to: f.T, offset: 3 m, noise", 18, "connections.0.offset is '3 m'"),
        ("variance: 4 K2", "variance: -9 K2", 18, "connections.0.noise.variance is -9"),
        ("stuck, value: 20 degC", "stuck, value: x", 21, "faults.1.value"),
    ],
)
def test_a_unit_that_does_not_fit_is_a_fault_with_its_place_beside_one_of_form(
    tmp_path: Path, old: str, new: str, line: int, fault: str
) -> None:
    text = heated(tmp_path, INPUT_UNITS + "nonsense: 1\n").read_text()
    assert text.count(old) == 1
    (tmp_path / "s.yaml").write_text(text.replace(old, new))
    found = {f.line: f.message for f in ScenarioFile(tmp_path / "s.yaml").faults}
    assert {*found} == {line, 28}
    assert fault in found[line]


def test_units_are_taken_from_set_and_from_python(tmp_path: Path) -> None:
    path = heated(tmp_path, f"{FIX}connections: [{{from: r.T, to: f.T}}]\n")
    file = ScenarioFile(path, ["duration=4 min", "step=20ms", "components.r.signals.T.start=0 degC"])
    assert (file.scenario.duration, file.scenario.step) == (240.0, 0.02)
    assert file.scenario.components["r"].signals["T"].start == 0.0  # type: ignore[union-attr]
    made = cosim.run(path, set={"duration": "2 s", "start_time": 0}, in_process=True, report=False)
    assert (made.time[-1], made["r.T"][0]) == (2.0, pytest.approx(26.85))
    assert made["f.T"][-1] == pytest.approx(300.0, rel=1e-15)
    words = f"simulate {tmp_path}/typed.fmu --stop 200ms --in-process --no-report --out {tmp_path}/out --step"
    told(*words.split(), "0.1 s")
    assert cosim.read(tmp_path / "out").time[-1] == pytest.approx(0.2)  # type: ignore[union-attr]


# -- models, studies, sweeps, protocols ------------------------------------------------------------


def test_parameters_of_a_model_file_are_converted(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(TANK)
    path = tmp_path / "model.yaml"
    path.write_text("model: tank.py:Tank\nparameters: {mass: 0.5 t, ambient: -15 degC}\n")
    assert read_model(path).parameters == pytest.approx({"mass": 500.0, "ambient": 258.15})
    path.write_text("model: tank.py:Tank\nparameters:\n  mass: 5 m\n  ambient: 900 degC\n  masss: 4 kg\n")
    with pytest.raises(InputError) as refused:
        read_model(path)
    assert [(f.line, f.column) for f in refused.value.faults] == [(3, 9), (4, 12), (5, 3)]
    assert "ambient is 1173.15; allowed range: [200, 400] K" in str(refused.value)


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
    assert study.logs[0].outputs["T"][:2] == pytest.approx([293.15, 293.25], rel=1e-15)
    for noise, reason in (("0.1 m", "'0.1 m'"), ("-0.9 degF", "-0.5: it should be greater than 0")):
        path.write_text(text.replace("0.18 degF", noise))
        with pytest.raises(InputError, match=f"study.yaml:3:12: noise.T is {reason}"):
            read_study(path)


def test_distributions_of_a_sweep_may_be_written_with_units(tmp_path: Path) -> None:
    heated(tmp_path)
    (tmp_path / "sweep.yaml").write_text(
        "scenario: s.yaml\nruns: 50\nsignals: [r.T]\nset: {duration: 2 s}\nvary:\n"
        "  components.r.signals.T.start: {uniform: [0 degC, 300 K]}\n"
        "  components.r.signals.phi.start: {normal: [10 deg, 0.001 rad]}\n"
    )
    sweep = read_sweep(tmp_path / "sweep.yaml")
    warm = np.array(sweep.columns["components.r.signals.T.start"])
    assert 0.0 <= warm.min() < 2.0 < 25.0 < warm.max() <= 26.85
    phi = np.array(sweep.columns["components.r.signals.phi.start"])
    assert phi.mean() == pytest.approx(10.0, abs=0.02)
    assert phi.std() == pytest.approx(math.degrees(0.001), rel=0.3)  # of 50 draws
