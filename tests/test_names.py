"""Names that FMI allows go everywhere: brackets, blanks, quotes, commas, signs of other scripts."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from cosim.core.errors import InputError
from cosim.residuals.workflow import replay
from cosim.simulation.workflow import run
from cosim.verbs.cli import command_line
from tests.cart import built
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
    return built(script, folder / "odd name.fmu")


def log_of(path: Path) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *ODD, *(f"out.{name}" for name in ODD)])
        for k in range(400):
            values = [0.1 * (k % 50 + n) for n in range(len(ODD))]
            writer.writerow([0.05 * k, *values, *(2.0 * v for v in values)])
    return path


def test_odd_names_are_connected_recorded_started_repeated_and_replayed(tmp_path: Path, odd: Path) -> None:
    table = log_of(tmp_path / "log.csv")
    wires = [(f"source.{n}", f"first.{n}") for n in ODD] + [(f"first.out.{n}", f"second.{n}") for n in ODD[1:]]
    scenario = {
        "name": "odd", "duration": 1.0, "step": 0.05,
        "components": {
            "source": {"block": "playback", "file": table.name},
            "first": {"fmu": str(odd)},
            "second": {"fmu": str(odd), "start": {ODD[0]: 3.5}},
        },
        "connections": [{"from": source, "to": target} for source, target in wires],
    }  # fmt: skip
    path = tmp_path / "odd.yaml"
    path.write_text(json.dumps(scenario))
    results = run(path, tmp_path / "out", [f"components.second.start.{ODD[0]}=4.5"]).results
    for n, name in enumerate(ODD[1:], 1):
        # Only a step computes these outputs: it sees the value of its start.
        assert results[f"second.out.{name}"][2] == pytest.approx(4.0 * results[f"source.{name}"][1])
        assert results[f"source.{name}"][2] == pytest.approx(0.1 * (2 + n))
    assert results[f"second.out.{ODD[0]}"][5] == 9.0
    run(tmp_path / "out" / "manifest.json", tmp_path / "again", report=False)
    assert (tmp_path / "again" / "results.csv").read_bytes() == (tmp_path / "out" / "results.csv").read_bytes()
    header = next(csv.reader((tmp_path / "out" / "results.csv").read_text().splitlines()))
    assert f"second.out.{ODD[2]}" in header
    comparison = replay(table, tmp_path / "replayed", odd).comparison
    assert set(comparison.log.inputs) == set(ODD)
    assert set(comparison.log.outputs) == {f"out.{name}" for name in ODD}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mas=1", 'has no variable "mas"; did you mean "mass"?'),
        ("mass=much", "[kg]"),
        ("mass=-1", "[0.05, 20] kg"),
        ("roll_ground_effect=2", "true or false"),
        ("x=1", "x=1: "),
        ("mass", "NAME=VALUE"),
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
        ("run plant.fmu", "`cosim info plant.fmu`"),
        ("run log.CSV", "`cosim check log.CSV`"),
        ("refine case.yaml", "is a scenario, not a study: `cosim run case.yaml`"),
        ("run study.yaml", "`cosim refine study.yaml`"),
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
