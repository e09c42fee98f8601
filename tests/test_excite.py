"""The experiment that separates rivals: what it promises, what it leaves, and that it keeps its promise.

The truth is flown by the blind suite's own craft (`tests.blind`), which shares no code with the model, under the
project's controller, with the noise of the sensors in the feedback.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from controller.loop import Loop
from controller.settings import Settings
from cosim.core.errors import InputError
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.experiment.excite import Excitation, excite
from cosim.logs.log import read_log
from cosim.refinement.search.attribution import Attributor
from cosim.simulation.workflow import run
from cosim.verbs.cli import command_line
from plant.hovercraft import Hovercraft
from tests.blind.truth import VARIANCE
from tests.blind.truth_craft import STEP, Craft, Flight
from tests.studies import Weighed, weighed

DRIVE = Path(__file__).parent.parent / "examples" / "drive" / "drive.py"
INPUTS = ("duty_right", "duty_left", "tilt_right", "tilt_left")
RIVALS = ("thrust_asymmetry", "com_offset")  # in a straight line one and the same: ε·L = −e
Told = dict[str, np.ndarray]
command = CliRunner()


def columns(path: Path) -> Told:
    with path.open() as stream:
        header, *rows = csv.reader(stream)
    return dict(zip((h.partition(" [")[0] for h in header), np.array(rows, dtype=float).T, strict=True))


def log_of_truth(path: Path, craft: Craft, told: Told) -> Path:
    """Fly references and duties on the independent craft and write the log."""
    flight, rng = Flight(craft, craft.rest(), tolerance=1e-8), np.random.default_rng(77)
    loop = Loop(Settings(), [0.0] * 5, told["x_ref"][0], told["psi_ref"][0])
    lines = [",".join(("time", *INPUTS, *VARIANCE))]
    for k in range(len(told["x_ref"])):
        now = flight.outputs()
        seen = {c: now[c] + math.sqrt(v) * rng.standard_normal() for c, v in VARIANCE.items()}
        if k:
            loop.step([seen[c] for c in ("psi", "psi_dot", "ax")], told["x_ref"][k], told["psi_ref"][k])
        acting = (told["duty_right"][k], told["duty_left"][k], *loop.command)
        lines.append(f"{k * STEP:.2f}," + ",".join(f"{v:.9g}" for v in (*acting, *seen.values())))
        flight.advance(acting, (0.0, 0.0, 0.0))
    path.write_text("\n".join(lines) + "\n")
    return path


def forth_and_back(seconds: float) -> Told:
    """Straight ahead and back, and nothing else: both propellers always tilted together."""
    time = np.arange(round(seconds / STEP) + 1) * STEP
    duty = np.full(len(time), Settings().duty_nominal)
    return {"x_ref": 0.3 * (time % 4.0 < 2.0), "psi_ref": 0.0 * time, "duty_right": duty, "duty_left": duty}


def attributed(log: Path) -> Weighed:
    """What refine makes of a log, the rivals its only candidates."""
    model = Hovercraft()
    subject = ModelSubject.of(model)
    problem = build_problem(subject, [read_log(log, model.inputs, model.outputs)])
    trial = [c for c in subject.candidates(()) if c.name in RIVALS]
    return weighed(Attributor(subject, problem, trial).run())


@pytest.fixture(scope="module")
def told_apart(tmp_path_factory: pytest.TempPathFactory) -> tuple[Excitation, Path]:
    folder = tmp_path_factory.mktemp("excitation")
    return excite("base", folder, RIVALS, duration=15.0, experiments=8), folder


@pytest.mark.thorough
def test_rivals_that_a_straight_line_cannot_tell_apart_are_told_by_the_excitation(
    told_apart: tuple[Excitation, Path], tmp_path: Path
) -> None:
    craft = Craft(effects={"thrust_asymmetry": {"ratio": 0.02}})
    poor = attributed(log_of_truth(tmp_path / "poor.csv", craft, forth_and_back(15.0)))
    assert poor.decision.rivals.keys() == {frozenset({name}) for name in RIVALS}
    flown = columns(told_apart[1] / "excitation.csv") | columns(told_apart[1] / "references.csv")
    rich = attributed(log_of_truth(tmp_path / "rich.csv", craft, flown))
    assert (rich.decision.verdict, rich.claimed) == ("effect_found", {"thrust_asymmetry"})
    # three standard deviations, or the test hangs on its seed
    ratio = rich.best.fit.values["thrust_asymmetry.ratio"]
    assert ratio == pytest.approx(0.02, abs=3 * rich.best.fit.sigma("thrust_asymmetry.ratio"))


@pytest.mark.thorough
def test_the_scenario_flies_what_was_promised(told_apart: tuple[Excitation, Path], tmp_path: Path) -> None:
    found, folder = told_apart
    rows = run(folder / "excitation.yaml", tmp_path, ["noise=off"], report=False).results
    played = columns(folder / "excitation.csv")
    assert list(played) == ["time", *INPUTS]
    for name in INPUTS:  # nine digits in the files; the loop holds what they lose at bay
        assert rows[f"plant.{name}"] == pytest.approx(played[name], abs=1e-6)
    for name in ("x_world", "y_world"):
        assert rows[f"plant.{name}"] == pytest.approx(found.trial.outputs[name], abs=1e-6)
        assert np.abs(rows[f"plant.{name}"]).max() <= found.question.limits[name]
    assert np.abs(played["tilt_right"]).max() <= math.radians(12) + 1e-9


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    def files(seed: int, name: str) -> list[bytes]:
        excite("base", tmp_path / name, ["lag", "actuator_delay"], duration=5.0, experiments=3, seed=seed)
        return [(tmp_path / name / f).read_bytes() for f in ("excitation.csv", "references.csv", "excitation.yaml")]

    first, again, other = files(1, "a"), files(1, "b"), files(2, "c")
    assert b'description: "To separate lag, actuator_delay."' in first[2]
    assert first == again
    assert first[0] != other[0]


@pytest.mark.thorough
def test_a_model_of_one_s_own_is_played_open_loop_within_its_limits(tmp_path: Path) -> None:
    model = f"{DRIVE}:Drive"
    found = excite(model, tmp_path, limits=["force=60", "position=150 mm"], duration=5.0, experiments=4)
    assert min(found.apart.values()) > min(found.usual.values())
    rows = run(tmp_path / "excitation.yaml", tmp_path / "run", report=False).results
    assert list(columns(tmp_path / "excitation.csv")) == ["time", "force"]
    assert np.abs(rows["plant.force"]).max() <= 60
    assert np.abs(rows["plant.position"]).max() <= 0.15


def refined(
    folder: Path,
    rivals: Sequence[str],
    ranking: list[dict[str, object]],
    hidden: Sequence[str] = (),
    noise: Mapping[str, float] | None = None,
) -> None:
    """A study of the hovercraft and what refine says of it."""
    (folder / "study.yaml").write_text("model: base\nlogs: {estimation: [a.csv]}\n")
    record = {"study": str(folder / "study.yaml"), "rivals": [*rivals], "candidates": ranking, "hidden": [*hidden]}
    (folder / "refine.json").write_text(
        json.dumps(record | {"measured": [*noise] if noise else ["psi", "ax"], "sensor_noise": noise or {}})
    )


@pytest.mark.thorough
def test_the_flight_is_planned_with_the_noise_that_the_logs_showed(tmp_path: Path) -> None:
    apart, pair = [], ("actuator_delay", "yaw_damping")
    for gyroscope in (0.02, 0.1):
        folder = tmp_path / str(gyroscope)
        folder.mkdir()
        refined(folder, pair, [], noise={"psi": 0.005, "psi_dot": gyroscope, "ax": 0.2})
        found = excite(str(folder), folder / "out", duration=10.0, experiments=1)
        apart.append(found.apart[pair])
        flown = (folder / "out" / "excitation.yaml").read_text()
        assert f"controller.psi_dot, noise: {{variance: {gyroscope**2:g}}}" in flown
    assert apart[0] > 1.5 * apart[1]


@pytest.mark.thorough
def test_a_pair_that_no_input_separates_does_not_decide_between_inputs(tmp_path: Path) -> None:
    blind = ("accelerometer_bias", "accelerometer_scale")  # one and the same where the acceleration is not logged

    def found(count: int) -> Excitation:
        rivals = [*blind, "yaw_damping"]
        return excite("base", tmp_path, rivals, measured=["psi", "psi_dot"], duration=10.0, experiments=count)

    first, best = found(1), found(6)
    assert best.apart[blind] == 0.0
    assert best.score > first.score
    assert best.apart[blind[0], "yaw_damping"] > 1.2 * first.apart[blind[0], "yaw_damping"]
    (warning,) = best.warnings
    assert "does not tell accelerometer_bias from accelerometer_scale (less than 3" in warning


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["base", "--range", "duty_rigth=0..10"],
            '--range duty_rigth=0..10: no input "duty_rigth"; did you mean "duty_ri',
        ),
        (["base", "--range", "ax=0..10"], '--range ax=0..10: no input "ax" (inputs: duty_right, duty_left'),
        (["base", "--range", "duty_right=10..0"], "say between what duty_right stays, lower end first [%], as duty_ri"),
        (["base", "--range", "tilt_right=0..10m"], "say between what tilt_right stays, lower end first [rad]"),
        (["base", "--range", "tilt_right=2..3"], "the model declares -1.5708..1.5708 rad of tilt_right"),
        (
            ["base", "--range", "tilt_right=1..8deg"],
            "--range: tilt_right=0.0174533..0.139626: the controller tilts both",
        ),
        (["base", "--against", "lagg"], 'no candidate "lagg"; did you mean "lag"?'),
        (["base", "--against", "lag", "--against", "lag"], '"lag" is named twice'),
        (["base", "--limit", "tilt_rigth=8deg"], 'no input or output "tilt_rigth"; did you mean "tilt_right"?'),
        (["base", "--limit", "tilt_right=8m"], "say how far tilt_right may go, above 0 [rad]"),
        (["base", "--measured", "ps"], 'no output "ps"; did you mean "psi"?'),
        (["none.yaml"], "none.yaml: no such file"),
        (  # the acceleration is not logged
            ["base", "--against", "accelerometer_bias", "--measured", "psi", "--duration", "5"],
            "base: none of 48 experiments drives any two rivals a standard deviation apart; try a wider --limit",
        ),
        (["base", "--duration", "4"], "--duration 4: an experiment lasts between 5 and 600 s for a step of 0.02 s"),
        ([f"{DRIVE}:Drive"], "how far from 0 may force go? Say --limit force=VALUE or --range force=MIN..MAX [N]"),
    ],
)
def test_a_question_that_cannot_be_asked_is_told_with_its_cure(
    tmp_path: Path, arguments: list[str], words: str
) -> None:
    done = command.invoke(command_line(), ["excite", *arguments, "--out", str(tmp_path)])
    assert isinstance(done.exception, InputError)
    assert done.exception.exit_code == 2
    assert words in str(done.exception)
    assert not list(tmp_path.iterdir())
