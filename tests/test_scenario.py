"""Bad scenarios: the place, every fault at once, the cure, and the exit code."""

from __future__ import annotations

from pathlib import Path

import pytest

from cosim.base.errors import InputError
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.storage.yaml_file import YamlFile
from cosim.system.system import build_system

GOOD = (Path(__file__).parent.parent / "scenarios" / "regulate.yaml").read_text()
ALONE = "it is a number alone: no unit of it is declared"


def read(path: Path, *overrides: str) -> None:
    """As a run reads it."""
    file = ScenarioFile(path, overrides)
    build_system(file)


def faults_of(project: Path, text: str, *overrides: str) -> list[str]:
    """Faults of a scenario text, each `line:column: message`."""
    path = project / "scenarios" / "case.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read(path, *overrides)
    return [str(f).removeprefix(f"{path}:") for f in caught.value.faults]


def test_a_step_that_is_none_brings_no_fault_of_what_it_would_have_to_fit(project: Path) -> None:
    text = GOOD + "criteria:\n  rms_error:\n    - {of: plant.x, after: 8, max: 1}\n"
    (told,) = faults_of(project, GOOD.split("criteria:")[0] + text.removeprefix(GOOD), "step=0")
    assert "step is 0: it should be greater than 0" in told


def test_the_shipped_scenarios_have_no_fault(project: Path) -> None:
    for name in ("regulate", "manoeuvre"):
        build_system(ScenarioFile(project / "scenarios" / f"{name}.yaml"))


@pytest.mark.parametrize(
    ("old", "new", "at", "words"),
    [
        ("seed: 1", "sed: 1", "sed", 'unknown key "sed"; did you mean "seed"?'),
        ("seed: 1", "live: {}", "live", '"live" is no longer supported'),
        (
            "fmu: ../build/plant.fmu",
            "fmu: ../build/plant.fmu\n    at: lab:5600",
            "at: lab",
            '"at" is no longer supported',
        ),
        ("duration: 10", "duration: ten", "ten", "duration is 'ten': it is a number [s], or text with a unit: 3 s"),
        ("duration: 10", "duration: -1", "-1", "greater than 0"),
        ("duration: 10", "duration: .inf", ".inf", "finite"),
        ("step: 0.02", "step: 1e-9", "1e-9", "steps, and a run may have"),
        ("x_start: 1,", "x_start: 1" + 400 * "0" + ",", "1" + 400 * "0", "finite number"),
        ("step: 0.02", "step: true", "true", "step is true"),
        ("step: 0.02", "step: .nan", ".nan", "finite"),
        ("step: 0.02", "step: 0.03", "0.03", "step is 0.03 s; use a whole divisor of duration 10 s"),
        ("step: 0.02\n", "", None, '"step" is missing; add it'),
        ("step: 0.02", "step: 0.05", "0.05", "step is 0.05 s; controller is sampled at 0.02 s (sample_time): set"),
        ("noise: on", "noise: perhaps", "perhaps", "it is on or off"),
        ("plant.fmu", "plnt.fmu", "../build/plnt.fmu", "no such FMU"),
        ("x_start: 1,", "x_strt: 1,", "1, psi_start", 'plant has no variable "x_strt"; did you mean "x_start"?'),
        ("x_start: 1,", "x_start: .inf,", ".inf", "finite number"),
        ("x_start: 1,", "mass: -1,", "-1,", "plant.mass is -1; it lies in [0.05, 20] kg"),
        ("x_start: 1,", "roll_ground_effect: 2,", "2, psi_start", "it is true or false"),
        ("x_start: 1,", "vx: 2,", "2, psi_start", "plant.vx is an output; it takes no start value"),
        ("12 deg", "12 degrees", "12 degrees", "text with a unit: 3 rad, 3 deg"),
        ("from: plant.psi,", "from: plant.psii,", "plant.psii", 'no output "psii"; did you mean "psi"?'),
        ("from: plant.psi,", "from: plan.psi,", "plan.psi", 'no component "plan"; did you mean "plant"?'),
        ("from: plant.psi,", "from: plant.tilt_right,", "plant.tilt_right", "an output goes to an input"),
        ("from: plant.psi,", "from: plant.vx,", "{from: plant.vx", "unit mismatch: plant.vx [m/s] to controller.psi"),
        ("to: controller.psi_dot", "to: controller.psi", "controller.psi, noise: {variance: 4", "two sources for"),
        ("variance: 2.613e-5", "variance: -1", "-1", "greater than or equal to 0"),
        ("variance: 2.613e-5", "varience: 1", "varience", 'did you mean "variance"?'),
        ("of: plant.phi", "of: plant.roll", "plant.roll", 'no signal "plant.roll"'),
        ("band: 0.02, max: 4.0", "max: 4.0", "{of: plant.x, max", "settling_time needs a band"),
        (
            "block: reference",
            "block: refrence",
            None,
            "a component has fmu: FILE, or block: reference, playback or fix",
        ),
    ],
)
def test_a_fault_names_its_place_and_its_cure(project: Path, old: str, new: str, at: str | None, words: str) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    faults = [fault for fault in faults_of(project, text) if words in fault]
    assert faults, faults_of(project, text)
    if at is not None:
        before = text[: text.index(at, GOOD.index(old) - 20)]
        place = f"{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}:"
        assert faults[0].startswith(place), (place, faults)


def test_faults_of_form_and_of_meaning_are_told_together(project: Path) -> None:
    text = GOOD.replace("seed: 1", "sed: 1").replace("step: 0.02", "step: 0.03").replace("plant.ax,", "plant.axe,")
    text = text.replace("variance: 2.613e-5", "variance: a").replace("x_start: 1,", "x_strt: 1,")
    text = text.replace("of: plant.phi", "of: plant.phy")
    lines = [int(fault.split(":")[0]) for fault in faults_of(project, text)]
    assert [GOOD.splitlines()[k - 1].split(":")[0].strip() for k in lines[:2]] == ["step", "seed"]
    assert lines == [6, 7, 13, 24, 26, 38]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("content", "place", "words"),
    [
        (b"name: a\nname: b\n", ":2:1", 'duplicate key "name"'),
        (b"a: {b: 1, b: 2}\n", ":1:11", 'duplicate key "b"'),
        (b"a: [1,\nb: }", ":2:4", "not YAML"),
        (b"name: x\n\tstep: 1\n", ":2:1", "not YAML"),
        (b"just words\n", ":1:1", "is not a mapping"),
        (b"", "", "is empty; give a scenario"),
        (b"\x00\x01", ":1:1", "not YAML"),
        (b"[" * 3000, ":1:1", "nested too deep"),
        (b"{scenario: 5, schema_version: 1}", ":1:1", "is missing"),
        (b"connections: 5", ":1:14", "it should be a list"),
        (b"criteria: {peak: 5}", ":1:18", "it should be a mapping of keys to values or a list"),
        (b"\xff\xfe\x00", "", "is not UTF-8 text"),
    ],
)
def test_what_is_not_yaml_is_said_to_be_so(tmp_path: Path, content: bytes, place: str, words: str) -> None:
    path = tmp_path / "case.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        ScenarioFile(path)
    assert f"{path}{place}: " in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("peak", "fault"),
    [
        ("{of: r.x, max: fast}", f"5:33: criteria.peak.max is 'fast': {ALONE}"),
        ("[{of: r.x, max: 5 rpm}]", f"5:34: criteria.peak.0.max is '5 rpm': {ALONE}"),
        ("{of: r.x}", '5:18: "criteria.peak.max" is missing; add it'),
    ],
)
def test_of_a_key_that_takes_several_forms_the_one_that_was_meant_is_judged_alone(
    tmp_path: Path, peak: str, fault: str
) -> None:
    path = tmp_path / "case.yaml"
    content = "name: n\nduration: 1\nstep: 0.1\ncomponents: {r: {block: reference, signals: {x: {}}}}\n"
    path.write_text(f"{content}criteria: {{peak: {peak}}}\n")
    assert [str(f) for f in ScenarioFile(path).faults] == [f"{path}:{fault}"]


def test_a_file_that_is_no_fmu_exits_3_and_a_fault_of_the_user_wins(project: Path) -> None:
    (project / "build" / "plant.fmu").write_text("not a zip")
    path = project / "scenarios" / "regulate.yaml"
    with pytest.raises(InputError) as caught:
        build_system(ScenarioFile(path))
    assert caught.value.exit_code == 3
    assert f"{path}:12:10: " in str(caught.value)
    with pytest.raises(InputError) as caught:
        build_system(ScenarioFile(path, ["step=0.03"]))
    assert caught.value.exit_code == 2


def test_set_reaches_every_place_of_a_scenario(project: Path) -> None:
    path = project / "scenarios" / "regulate.yaml"
    overrides = [
        "noise=off", "seed=7", "components.plant.start.coulomb_friction.force=0.05",
        "connections.0.noise.variance=0", "components.controller.start.estimator=lagged",
        "components.plant.start={x_start: 2}",
    ]  # fmt: skip
    scenario = ScenarioFile(path, overrides[:-1]).scenario
    assert (scenario.noise, scenario.seed) == (False, 7)
    assert scenario.components["plant"].start["coulomb_friction.force"] == 0.05  # type: ignore[union-attr]
    assert scenario.connections[0].noise is not None
    assert scenario.connections[0].noise.variance == 0
    assert ScenarioFile(path, overrides[-1:]).scenario.components["plant"].start == {"x_start": 2}  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "override", ["noise", "=3", "connections.².noise=null", "connections.99.noise=1", "name.x.y=1"]
)
def test_a_set_that_fits_nowhere_is_refused(project: Path, override: str) -> None:
    with pytest.raises(InputError, match="--set"):
        ScenarioFile(project / "scenarios" / "regulate.yaml", [override])


def test_an_angle_may_be_given_in_degrees(project: Path) -> None:
    file = ScenarioFile(project / "scenarios" / "regulate.yaml")
    block = next(s.component for s in build_system(file).stages if s.component.name == "controller")
    assert block.start_values["tilt_max"] == pytest.approx(0.20943951, abs=1e-8)  # type: ignore[attr-defined]


def test_swap_differs_from_regulate_in_one_line_of_the_system() -> None:
    folder = Path(__file__).parent.parent / "scenarios"
    one, other = ((folder / f"{name}.yaml").read_text() for name in ("regulate", "swap"))
    system_of = [t[t.index("duration:") : t.index("criteria:")].splitlines() for t in (one, other)]
    differing = [(a, b) for a, b in zip(*system_of, strict=True) if a != b]
    assert len(differing) == 1
    assert "fmu:" in differing[0][0]


def test_an_override_of_a_component_that_is_not_there_is_a_fault(project: Path) -> None:
    for path in ("components.plnt.fmu", "components.plnt"):
        (fault,) = faults_of(project, GOOD, f"{path}=../build/plant.fmu")
        assert 'component "plnt", which is not in the scenario; did you mean "plant"?' in fault


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("name: x\n? {a: b}\n: 1\n", "2:3", "a key is text"),
        ("name: x\n? [a]\n: 1\n", "2:3", "a key is text"),
        ('name: x\n"x]": 1\n', "2:1", 'unknown key "x]"'),
        ('name: x\n"«fmu»": 1\n', "2:1", 'unknown key "«fmu»"'),
        ('components:\n  "[key]": 1\n', "2:3", "components.[key] is"),
        ("name: !!python/object:os.system x\n", "1:7", 'the tag "!!python/object:os.system" means nothing here'),
        ("name: &a [*a]\n", "1:7", "nested too deep"),
        ("name: " + 400 * "[" + "\n", "2:1", "not YAML"),
        ("name: " + 80 * "[" + 80 * "]" + "\n", "", "nested too deep"),
        ("name: 0x\nduration: 1_\n", "", "is missing"),
        (b"name: x\0", "1:1", "special characters"),
        ("--- a\n--- b\n", "2:1", "single document"),
        ('name: x\n"\\ud83d": 1\n', "2:1", "half a character"),
        ('{"name": "\\ude42"}', "1:10", "half a character"),
    ],
)
def test_odd_yaml_is_refused_with_its_place(tmp_path: Path, text: str | bytes, place: str, words: str) -> None:
    path = tmp_path / "case.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        read(path)
    assert any(str(f).startswith(f"{path}:{place}") and words in f.message for f in caught.value.faults), caught.value


def test_an_alias_bomb_is_refused_before_it_is_spread_out(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match="aliases are expanded"):
        read(path)


def test_aliases_and_merged_keys_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text(
        "name: x\nduration: 1\nstep: 0.5\ncomponents:\n"
        "  a: &a {block: reference, signals: {u: {start: 1}}}\n  b: *a\n"
        "  c: {<<: *a, signals: {v: {start: 2}}}\n"
    )
    scenario = ScenarioFile(path).scenario
    assert scenario.components["b"] == scenario.components["a"]
    assert list(scenario.components["c"].signals) == ["v"]  # type: ignore[union-attr]


def test_characters_in_two_halves_as_json_writes_them_are_made_whole(tmp_path: Path) -> None:
    for text in ('name: "\\ud83d\\ude42"', '{"name": "\\ud83d\\ude42"}'):
        path = tmp_path / "case.yaml"
        path.write_text(text)
        assert YamlFile(path).root == {"name": "\U0001f642"}


def test_a_scenario_in_json_has_places_too(tmp_path: Path) -> None:
    path = tmp_path / "case.json"
    path.write_text('{"name": "x", "duration": 1, "step": 0.5,\n "components": {"a": {"blok": 1}}}')
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}:2:")


def test_a_step_that_the_sample_time_follows_is_no_fault(project: Path) -> None:
    path = project / "scenarios" / "regulate.yaml"
    read(path, "step=0.05", "components.controller.start.sample_time=0.05")


def test_json_that_is_no_yaml_has_faults_without_places(tmp_path: Path) -> None:
    path = tmp_path / "case.json"
    path.write_text('{"name": "\x7f", "duration": 1, "step": 0.5, "components": {"a": {"blok": 1}}}')
    with pytest.raises(InputError, match="a component has fmu"):
        read(path)


def test_a_name_that_no_file_may_have_is_no_such_fmu(tmp_path: Path) -> None:
    path = tmp_path / "case.yaml"
    path.write_text("name: x\nduration: 1\nstep: 0.5\ncomponents:\n  a: {fmu: a.fmu}\n")
    with pytest.raises(InputError, match=r"case.yaml: --set .components.a.fmu=.* no such FMU"):
        run(path, tmp_path / "out", [r'components.a.fmu="\u0000"'])
