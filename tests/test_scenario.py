"""Faults of scenarios: the place, every fault at once, and the exit code; and what else a scenario may hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError
from cosim.files.yaml_file import YamlFile
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.conftest import ROOT

GOOD = (ROOT / "scenarios" / "regulate.yaml").read_text(encoding="utf-8")
SMALL = "name: n\nduration: 1\nstep: 0.1\ncomponents: {r: {block: reference, signals: {x: {}}}}\n"


def faults_of(path: Path, text: str | bytes, *overrides: str) -> InputError:
    """The faults of a scenario, as a run reads it."""
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        build_system(ScenarioFile(path, overrides))
    return caught.value


def place_of(text: str) -> tuple[int, int]:
    """Line and column of the part after @."""
    before = text[: text.index("@")]
    return before.count("\n") + 1, len(before) - before.rfind("\n")


BOMB = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]  # refused before it is spread out
BOMB += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
FAULTS = [  # a part of regulate.yaml → what stands in its place: @ is before the part at fault
    "seed: 1 → @sed: 1",
    "design:  → @design: {}\n",
    "seed: 1 → @live: {}",
    "fmu: ../build/plant.fmu → @at: lab:5600\n    fmu: ../build/plant.fmu",
    "duration: 10 → duration: @ten",
    "duration: 10 → duration: @.inf",
    "step: 0.02 → step: @1e-9",
    "step: 0.02 → step: @true",
    "step: 0.02 → step: @0.03",
    "step: 0.02 → step: @0.05",  # the controller is sampled at 0.02 s
    "step: 0.02 → step: @{max: 0.02}",
    "step: 0.02 → step: {max: 0.02, min: @0.03}",
    "step: 0.02 → step: {max: 0.02, min: 0.001, estimator: @energy}",
    "noise: on → noise: @perhaps",
    "noise: on → record: {every: @0.03}",
    "plant.fmu → plnt.fmu → fmu: @../build/plnt.fmu",
    f"x_start: 1, → x_start: @1{'0' * 400},",
    "x_start: 1, → x_strt: @1,",
    "x_start: 1, → x_start: @.inf,",
    "x_start: 1, → x_start: @3 kg,",
    "x_start: 1, → mass: @-1,",
    "x_start: 1, → roll_ground_effect: @2,",
    "x_start: 1, → vx: @2,",
    "12 deg → @12 degrees",
    "from: plant.psi, → from: @plant.psii,",
    "from: plant.psi, → from: @plan.psi,",
    "from: plant.psi, → from: @plant.tilt_right,",
    "{from: plant.psi, → @{from: plant.vx,",
    "to: controller.psi_dot → to: @controller.psi",
    "variance: 2.613e-5 → variance: @-1",
    "variance: 2.613e-5 → variance: @3 kg2",
    "variance: 2.613e-5 → @varience: 1",
    "of: plant.phi → of: @plant.roll",
    "{of: plant.x, band: 0.02, max: 4.0 → @{of: plant.x, max: 4.0",
    "block: reference → @block: refrence",
]


@pytest.mark.parametrize("case", FAULTS, ids=lambda case: case[:60])
def test_a_fault_has_the_place_of_its_value(project: Path, case: str) -> None:
    old, new, *more = case.split(" → ")
    good = GOOD if old in GOOD else f"{GOOD}{old}"
    text = good.replace(old, new, 1)
    marked = text.replace(more[0].replace("@", ""), more[0]) if more else text
    error = faults_of(project / "scenarios" / "case.yaml", text.replace("@", ""))
    assert error.exit_code == 2
    assert place_of(marked) in [(fault.line, fault.column) for fault in error.faults]


@pytest.mark.parametrize(
    "text",
    [
        "name: x\n? @{a: b}\n: 1\n",
        'name: x\n@"«fmu»": 1\n',
        "name: @!!python/object:os.system x\n",
        "name: @&a [*a]\n",
        f"name: {400 * '['}\n@",
        f"name: {80 * '['}{80 * ']'}\n",
        "name: 0x\nduration: 1_\n",
        "@name: x\0",
        "--- a\n@--- b\n",
        'name: x\n@"\\ud83d": 1\n',
        '{"name": @"\\ude42"}',
        '{"name": "x", "duration": 1, "step": 0.5,\n "components": {"a": @{"blok": 1}}}',
        '{"name": "\x7f", "duration": 1, "step": 0.5, "components": {"a": {"blok": 1}}}',  # JSON that is no YAML
        f"{SMALL}criteria: {{peak: {{of: r.x, max: @fast}}}}\n",
        f"{SMALL}criteria: {{peak: [{{of: r.x, max: @5 rpm}}]}}\n",
        f"{SMALL}criteria: {{peak: @{{of: r.x}}}}\n",
        f"{SMALL}criteria: {{peak: @{{of: r.x, max: 1, after: 2}}}}\n",
        f"{SMALL}criteria: {{peak: @{{of: r.x, max: 1, band: 1}}}}\n",
        "name: a\n@name: b\n",
        "a: [1,\nb: @}",
        "name: x\n@\tstep: 1\n",
        "@just words\n",
        "@\0\1",
        f"@{3000 * '['}",
        "@{scenario: 5, schema_version: 1}",
        "connections: @5",
        "criteria: {peak: @5}",
        "\n".join(BOMB),
    ],
    ids=lambda text: text[:40],
)
def test_odd_files_are_refused_with_the_place(tmp_path: Path, text: str) -> None:
    error = faults_of(tmp_path / "case.yaml", text.replace("@", ""))
    assert error.exit_code == 2
    assert "@" not in text or place_of(text) in [(fault.line, fault.column) for fault in error.faults]


@pytest.mark.parametrize("content", [b"\xff\xfe\0", b"", b"- a\n", 9_000_000 * b"#"], ids=len)
def test_files_that_are_no_mapping_are_refused(tmp_path: Path, content: bytes) -> None:
    assert faults_of(tmp_path / "case.yaml", content).exit_code == 2


@pytest.mark.parametrize(
    "override",
    ["noise", "=3", "connections.².noise=null", "connections.99.noise=1", "name.x.y=1", "components.plnt=1",
     "components.plnt.fmu=../build/plant.fmu", "seed=-1", r'components.plant.fmu="\u0000"'],
)  # fmt: skip
def test_a_set_that_fits_nowhere_is_refused(project: Path, override: str) -> None:
    error = faults_of(project / "scenarios" / "case.yaml", GOOD, override)
    assert error.exit_code == 2
    assert all("--set" in fault.message and not fault.line for fault in error.faults)


def test_faults_of_form_and_of_meaning_are_told_together_and_none_that_follows_from_another(project: Path) -> None:
    path = project / "scenarios" / "case.yaml"
    text = GOOD.replace("seed: 1", "sed: 1").replace("step: 0.02", "step: 0.05").replace("plant.ax,", "plant.axe,")
    text = text.replace("variance: 2.613e-5", "variance: a").replace("x_start: 1,", "x_strt: 1,")
    text = text.replace("of: plant.phi", "of: plant.phy")
    assert [fault.line for fault in faults_of(path, text).faults] == [6, 7, 13, 24, 26, 38]
    text = GOOD.split("criteria:")[0] + "criteria:\n  rms_error:\n    - {of: plant.x, after: 8, max: 1}\n"
    (fault,) = faults_of(path, text, "step=0").faults
    assert "step" in fault.message


def test_a_file_that_is_no_fmu_exits_3_and_a_fault_of_the_user_wins(project: Path) -> None:
    (project / "build" / "plant.fmu").write_text("not a zip")
    path, marked = project / "scenarios" / "case.yaml", GOOD.replace("../build/plant.fmu", "@../build/plant.fmu")
    error = faults_of(path, GOOD)
    assert error.exit_code == 3
    assert [(fault.line, fault.column) for fault in error.faults] == [place_of(marked)]
    assert faults_of(path, GOOD, "step=0.03").exit_code == 2


# -- what is taken -----------------------------------------------------------------------------------


def test_set_reaches_every_place_of_a_scenario(project: Path) -> None:
    path = project / "scenarios" / "regulate.yaml"
    overrides = [
        "noise=off", "seed=7", "components.plant.start.coulomb_friction.force=0.05", "connections.0.noise.variance=0",
    ]  # fmt: skip
    scenario: Any = ScenarioFile(path, overrides).scenario
    assert (scenario.noise, scenario.seed, scenario.connections[0].noise.variance) == (False, 7, 0)
    assert scenario.components["plant"].start["coulomb_friction.force"] == 0.05
    scenario = ScenarioFile(path, ["components.plant.start={x_start: 2}"]).scenario
    assert scenario.components["plant"].start == {"x_start": 2}


def test_an_angle_may_be_given_in_degrees_and_a_component_may_have_the_step_of_its_scenario(project: Path) -> None:
    stages = build_system(ScenarioFile(project / "scenarios" / "regulate.yaml", ["components.plant.step=0.02"])).stages
    assert {stage.every for stage in stages} == {1}
    block = next(s.component for s in stages if s.component.name == "controller")
    assert block.start_values["tilt_max"] == pytest.approx(0.20943951, abs=1e-8)  # type: ignore[attr-defined]


def test_a_step_that_the_sample_time_follows_is_no_fault(project: Path) -> None:
    path = project / "scenarios" / "manoeuvre.yaml"
    build_system(ScenarioFile(path, ["step=0.05", "components.controller.start.sample_time=0.05"]))


def test_aliases_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text(
        "name: x\nduration: 1\nstep: 0.5\ncomponents:\n  a: &a {block: reference, signals: {u: {start: 1}}}\n  b: *a\n"
    )
    scenario = ScenarioFile(path).scenario
    assert scenario.components["b"] == scenario.components["a"]


def test_characters_in_two_halves_as_json_writes_them_are_made_whole(tmp_path: Path) -> None:
    for text in ('name: "\\ud83d\\ude42"', '{"name": "\\ud83d\\ude42"}'):
        path = tmp_path / "case.yaml"
        path.write_text(text)
        assert YamlFile(path).root == {"name": "\U0001f642"}
