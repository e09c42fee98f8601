"""Names that FMI allows go everywhere: brackets, blanks, quotes, commas, signs of other scripts."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import pytest
from pythonfmu.builder import FmuBuilder

from cosim.core.errors import InputError
from cosim.fmi.fmu_build import build
from cosim.residuals.workflow import replay
from cosim.simulation.workflow import run
from cosim.verbs.cli import command_line
from fmus.recipes import plant_recipe
from tests.test_log import RECORDED

ODD = ("p_Crane.e[1]", 'it\'s a "name"', "a,b [c]", "der(x[1, 2])", "ψ <&> $x", "percent %s {0}")
SOURCE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Odd(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.values = {{}}
        for name in {names!r}:
            self.one(name, Fmi2Causality.input)
            self.one("out." + name, Fmi2Causality.output)

    def one(self, name, causality):
        self.values[name] = 0.0
        start = {{"start": 0.0}} if causality is Fmi2Causality.input else {{}}
        self.register_variable(Real(name, causality=causality, getter=lambda: self.values[name],
                                    setter=lambda v: self.values.__setitem__(name, v)))

    def do_step(self, current_time, step_size):
        for name in {names!r}:
            self.values["out." + name] = 2.0 * self.values[name]
        return True
"""


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("odd")
    script = folder / "odd.py"
    script.write_text(SOURCE.format(names=ODD))
    path, modules = list(sys.path), set(sys.modules)
    try:
        return Path(FmuBuilder.build_FMU(script, folder / "odd name.fmu"))
    finally:
        sys.path[:] = path
        for module in set(sys.modules) - modules:
            if module == "odd":
                del sys.modules[module]


def log_of(path: Path, names: tuple[str, ...] = ODD) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *names, *(f"out.{name}" for name in names)])
        for k in range(400):
            values = [0.1 * (k % 50 + n) for n in range(len(names))]
            writer.writerow([0.05 * k, *values, *(2.0 * v for v in values)])
    return path


def test_odd_names_are_connected_recorded_started_and_repeated(tmp_path: Path, odd: Path) -> None:
    table = log_of(tmp_path / "log.csv")
    connections = [{"from": f"source.{n}", "to": f"first.{n}"} for n in ODD]
    connections += [{"from": f"first.out.{n}", "to": f"second.{n}"} for n in ODD[1:]]
    scenario = {
        "name": "odd", "duration": 1.0, "step": 0.05,
        "components": {
            "source": {"block": "playback", "file": table.name},
            "first": {"fmu": str(odd)},
            "second": {"fmu": str(odd), "start": {ODD[0]: 3.5}},
        },
        "connections": connections,
        "criteria": {"peak": {"of": f"second.out.{ODD[1]}", "max": 100.0}},
    }  # fmt: skip
    path = tmp_path / "odd.yaml"
    path.write_text(json.dumps(scenario))
    outcome = run(path, tmp_path / "out", [f"components.second.start.{ODD[0]}=4.5"])
    results = outcome.results
    for n, name in enumerate(ODD[1:], 1):
        # Only a step computes these outputs: it sees the value of its start.
        assert results[f"second.out.{name}"][2] == pytest.approx(4.0 * results[f"source.{name}"][1])
        assert results[f"source.{name}"][2] == pytest.approx(0.1 * (2 + n))
    assert results[f"second.out.{ODD[0]}"][5] == 9.0
    again = run(tmp_path / "out" / "manifest.json", tmp_path / "again", report=False)
    assert (again.folder / "results.csv").read_bytes() == (tmp_path / "out" / "results.csv").read_bytes()
    header = next(csv.reader((tmp_path / "out" / "results.csv").read_text().splitlines()))
    assert f"second.out.{ODD[2]}" in header


def test_a_log_with_odd_names_is_replayed(tmp_path: Path, odd: Path) -> None:
    comparison = replay(log_of(tmp_path / "log.csv"), tmp_path / "out", odd).comparison
    assert set(comparison.log.inputs) == set(ODD)
    assert set(comparison.log.outputs) == {f"out.{name}" for name in ODD}


@pytest.mark.thorough
def test_a_parameter_given_to_a_replay_is_as_if_built_in(tmp_path: Path, plant_fmu: Path) -> None:
    heavy = build(plant_recipe({"mass": 0.9}), tmp_path / "heavy.fmu")
    replay(RECORDED, tmp_path / "a", heavy, report=False)
    replay(RECORDED, tmp_path / "b", plant_fmu, start=["mass=900 g"], report=False)
    assert (tmp_path / "a/results.csv").read_bytes() == (tmp_path / "b/results.csv").read_bytes()
    replay(RECORDED, tmp_path / "c", plant_fmu, start=["psi_start=30 deg"], report=False)
    header, first, *_ = csv.reader((tmp_path / "c/results.csv").read_text().splitlines())
    assert float(first[header.index("plant.psi")]) == pytest.approx(0.5235987755982988)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mas=1", 'has no variable "mas"; did you mean "mass"?'),
        ("mass=much", "it is a number [kg]"),
        ("mass=-1", "it lies in"),
        ("roll_ground_effect=2", "it is true or false"),
        ("x=1", "it takes no start value"),
        ("mass", "it is NAME=VALUE"),
    ],
)
def test_a_start_value_that_does_not_fit_is_refused(tmp_path: Path, plant_fmu: Path, text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        replay(RECORDED, tmp_path / "out", plant_fmu, start=[text])
    assert words in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run plant.fmu", "is an FMU, not a scenario or a manifest: `cosim info plant.fmu`"),
        ("run log.CSV", "is a log, not a scenario or a manifest: `cosim check log.CSV`"),
        ("refine case.yaml", "is a scenario, not a study: `cosim run case.yaml`"),
        ("run study.yaml", "is a study, not a scenario or a manifest: `cosim refine study.yaml`"),
        ("replay case.yaml", "is a scenario, not a log: `cosim run case.yaml`"),
    ],
)
def test_a_file_of_another_kind_is_told_with_the_command_that_reads_it(
    tmp_path: Path, plant_fmu: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plant.fmu").write_bytes(plant_fmu.read_bytes())
    (tmp_path / "log.CSV").write_bytes(RECORDED.read_bytes())
    (tmp_path / "case.yaml").write_text("components: {}\n")
    (tmp_path / "study.yaml").write_text("logs: {estimation: [log.CSV]}\n")
    with pytest.raises(InputError) as caught:
        command_line()(arguments.split(), standalone_mode=False)
    assert words in str(caught.value)
    assert caught.value.exit_code == 2
