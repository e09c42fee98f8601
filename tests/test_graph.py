"""A scenario as a picture: SVG, and in the report."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from cosim.verbs.checks import graph_of
from tests.test_first_steps import told
from tests.typed import typed_fmu


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    typed_fmu(tmp_path, units=("m", "m"))
    path = tmp_path / "pair.yaml"
    path.write_text("""name: pair
duration: 1
step: 0.1
components: {b: {fmu: typed.fmu}, a: {fmu: typed.fmu}, r: {block: reference, signals: {x: {unit: m}}}}
connections:
- {from: r.x, to: a.r_in, noise: {variance: 0.04}}
- {from: a.r_out, to: b.r_in}
- {from: b.i_out, to: a.i_in}
faults: [{on: b.r_in, kind: bias, value: 0.5, from: 0.2, to: 0.4}]
""")
    return path


def test_the_picture_shows_order_signals_units_noise_and_faults(scenario: Path) -> None:
    graph = graph_of(scenario)
    nodes = ElementTree.fromstring(graph.svg()).iter("{http://www.w3.org/2000/svg}text")
    shown = ["".join(node.itertext()) for node in nodes]
    names = [stage.component.name for stage in build_system(ScenarioFile(scenario)).stages]
    assert [text for text in shown if text[:1].isdigit()] == [f"{k} {name}" for k, name in enumerate(names, 1)]
    for text in (
        "r_in [m]",
        "r_out [m]",
        "x [m]",
        "noise σ\u00a0=\u00a00.200\u00a0m",
        "fault: bias 0.5 from 0.2 s to 0.4 s",
    ):
        assert text in shown
    # a value of the step's start is dashed; a reference, set before the outputs are read, is no such value
    assert graph_of(scenario, ["algorithm=jacobi"]).svg().count('class="wire held"') == 2
    assert graph.svg().count('class="wire held"') == sum(link.held for link in graph.links) < 3


def test_a_file_that_is_no_scenario_or_picture_is_told(scenario: Path, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,x\n0,0\n")
    assert "is a log, not a scenario" in told("graph", tmp_path / "log.csv", code=2)
    for name in ("x.png", "no/x.svg"):
        told("graph", scenario, "--out", tmp_path / name, code=2)


def test_a_picture_is_drawn_again_but_over_no_other_file(scenario: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.svg"
    for _ in range(2):
        told("graph", scenario, "--out", path)
    mine = path.read_text()
    path.write_text("<svg/>")
    told("graph", scenario, "--out", path, code=2)
    assert path.read_text() != mine
    told("graph", scenario, "--out", path, "--force")
    assert path.read_text() == mine
