"""The experiment that separates rivals: what it promises and leaves, and that it commands nothing an input cannot take.

The truth is flown by the blind suite's own craft (`tests.blind`), which shares no code with the model, under the
project's controller, with the noise of the sensors in the feedback.
"""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from controller.loop import Loop
from controller.settings import Settings
from cosim.core.errors import InputError
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.experiment.excite import excite
from cosim.experiment.question import ask
from cosim.logs.log import read_log
from cosim.refinement.search.attribution import Attributor
from cosim.simulation.workflow import run
from plant.hovercraft import Hovercraft
from tests.blind.truth_craft import STEP, VARIANCE, Craft, Flight
from tests.studies import Weighed, weighed
from tests.test_first_steps import told

DRIVE = Path(__file__).parent.parent / "examples" / "drive" / "drive.py"
INPUTS = ("duty_right", "duty_left", "tilt_right", "tilt_left")
RIVALS = ("thrust_asymmetry", "com_offset")  # in a straight line one and the same: ε·L = −e
Told = dict[str, np.ndarray]


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


def attributed(log: Path) -> Weighed:
    """What refine makes of a log, the rivals its only candidates."""
    model = Hovercraft()
    subject = ModelSubject.of(model)
    problem = build_problem(subject, [read_log(log, model.inputs, model.outputs)])
    trial = [c for c in subject.candidates(()) if c.name in RIVALS]
    return weighed(Attributor(subject, problem, trial).run())


@pytest.mark.thorough
def test_rivals_that_a_straight_line_cannot_tell_apart_are_told_by_the_excitation(tmp_path: Path) -> None:
    found = excite("base", tmp_path, RIVALS, duration=15.0, experiments=8)
    played, craft = columns(tmp_path / "excitation.csv"), Craft(effects={"thrust_asymmetry": {"ratio": 0.02}})
    # straight ahead and back, and nothing else: both propellers always tilted together
    time = played["time"]
    straight = {"x_ref": 0.3 * (time % 4.0 < 2.0), "psi_ref": 0.0 * time}
    straight |= dict.fromkeys(INPUTS[:2], np.full(time.size, Settings().duty_nominal))
    poor = attributed(log_of_truth(tmp_path / "poor.csv", craft, straight))
    assert poor.decision.verdict == "ambiguous"
    assert poor.decision.rivals.keys() >= {frozenset({name}) for name in RIVALS}  # both at once may be a third
    rich = attributed(log_of_truth(tmp_path / "rich.csv", craft, played | columns(tmp_path / "references.csv")))
    assert (rich.decision.verdict, rich.claimed) == ("effect_found", {"thrust_asymmetry"})
    # three standard deviations, or the test hangs on its seed
    ratio = rich.best.fit.values["thrust_asymmetry.ratio"]
    assert ratio == pytest.approx(0.02, abs=3 * rich.best.fit.sigma("thrust_asymmetry.ratio"))
    # and the scenario flies what was promised
    rows = run(tmp_path / "excitation.yaml", tmp_path / "run", ["noise=off"], report=False).results
    assert list(played) == ["time", *INPUTS]
    promised = {n: played[n] for n in INPUTS} | {n: found.trial.outputs[n] for n in ("x_world", "y_world")}
    for name, values in promised.items():  # nine digits in the files; the loop holds what they lose at bay
        assert rows[f"plant.{name}"] == pytest.approx(values, abs=1e-6)
    assert all(np.abs(promised[name]).max() <= found.question.limits[name] for name in ("x_world", "y_world"))
    assert np.abs(played["tilt_right"]).max() <= math.radians(12) + 1e-9


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    def files(seed: int, name: str) -> list[bytes]:
        excite("base", tmp_path / name, ["lag", "actuator_delay"], duration=5.0, experiments=3, seed=seed)
        return [(tmp_path / name / f).read_bytes() for f in ("excitation.csv", "references.csv", "excitation.yaml")]

    first, again, other = files(1, "a"), files(1, "b"), files(2, "c")
    assert first == again
    assert first[0] != other[0]


@pytest.mark.thorough
def test_the_flight_is_planned_with_the_noise_that_the_logs_showed(tmp_path: Path) -> None:
    apart, pair = [], ("actuator_delay", "yaw_damping")
    (tmp_path / "study.yaml").write_text("model: base\nlogs: {estimation: [a.csv]}\n")
    for gyroscope in (0.02, 0.1):
        noise = {"psi": 0.005, "psi_dot": gyroscope, "ax": 0.2}
        record = {"study": str(tmp_path / "study.yaml"), "rivals": pair, "candidates": [], "hidden": []}
        (tmp_path / "refine.json").write_text(json.dumps(record | {"measured": [*noise], "sensor_noise": noise}))
        found = excite(str(tmp_path), tmp_path / "out", duration=10.0, experiments=1, force=True)
        apart.append(found.apart[pair])
        flown = (tmp_path / "out" / "excitation.yaml").read_text()
        assert f"controller.psi_dot, noise: {{variance: {gyroscope**2:g}}}" in flown
    assert apart[0] > 1.5 * apart[1]


@pytest.mark.thorough
def test_a_pair_that_no_input_separates_does_not_decide_between_inputs(tmp_path: Path) -> None:
    blind = ("accelerometer_bias", "accelerometer_scale")  # one and the same where the acceleration is not logged

    first, best = (
        excite(
            "base",
            tmp_path / str(count),
            [*blind, "yaw_damping"],
            measured=["psi", "psi_dot"],
            duration=10.0,
            experiments=count,
        )
        for count in (1, 6)
    )
    assert best.apart[blind] == 0.0
    assert best.score > first.score
    assert best.apart[blind[0], "yaw_damping"] > 1.2 * first.apart[blind[0], "yaw_damping"]
    (warning,) = best.warnings
    assert "accelerometer_bias from accelerometer_scale" in warning


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["base", "--range", "duty_rigth=0..10"], "--range duty_rigth=0..10: no input"),
        (["base", "--range", "duty_right=10..0"], "duty_right [%]"),
        (["base", "--range", "tilt_right=2..3"], "-1.5708..1.5708 rad for tilt_right"),
        (["base", "--range", "tilt_right=1..8deg"], "--range: tilt_right=0.0174533..0.139626"),
        (["base", "--against", "lagg"], 'no candidate "lagg"; did you mean "lag"?'),
        (["base", "--against", "lag", "--against", "lag"], '"lag" is named twice'),
        (["base", "--measured", "ps"], 'no output "ps"; did you mean "psi"?'),
        (  # the acceleration is not logged
            ["base", "--against", "accelerometer_bias", "--measured", "psi", "--duration", "5"],
            "base: none of 48 experiments",
        ),
        (["base", "--duration", "4"], "--duration 4: "),
        ([f"{DRIVE}:Drive"], "--limit force=VALUE or --range force=MIN..MAX [N]"),
    ],
)
def test_a_question_that_cannot_be_asked_is_told_with_its_cure(
    tmp_path: Path, arguments: list[str], words: str
) -> None:
    assert words in told("excite", *arguments, "--out", tmp_path, code=2)
    assert not list(tmp_path.iterdir())


FAN = """
from dataclasses import dataclass

from cosim.model import Equations, Model, Offset, Quantity, parameter, size

Draught = Offset.named("draught", place="air", value=size("m/s", (-5, 5), 0.5, "d"))


@dataclass(frozen=True, kw_only=True)
class Fan(Model):
    base_states = outputs = (Quantity("wind", "m/s", "of the air"),)
    inputs = (Quantity("fan", "%", "speed of the fan", 20.0BOUNDS),)
    catalogue, places, forced, calibrated = (Draught,), ("air",), ("wind",), ("gain",)
    sensor_variance = {"wind": 1e-4}
    gain: float = parameter(0.1, unit="m/s", bounds=(0, 1), doc="k for each percent")

    def equations(self, m):
        at = self.effects_at(m)
        return Equations(lambda t, x, u: (at("air", self.gain * u[0] - x[0]),), lambda t, x, u: x)
"""


def fan(folder: Path, bounds: str = ", (0.0, 100.0)") -> str:
    (folder / "fan.py").write_text(FAN.replace("BOUNDS", bounds))
    return f"{folder / 'fan.py'}:Fan"


@pytest.mark.parametrize("limits", [[], ["fan=90"]])
def test_a_fan_is_never_told_to_run_backwards(tmp_path: Path, limits: list[str]) -> None:
    found = excite(fan(tmp_path), tmp_path / "out", limits=limits, duration=10.0, experiments=6)
    played = np.loadtxt(tmp_path / "out" / "excitation.csv", delimiter=",", skiprows=1)[:, 1]
    assert 0.0 <= played.min() < 50.0 < played.max() <= 100.0  # it is played all the same
    usual = found.rig.play(found.question.loaded.model, found.rig.usual_signals(found.trial.time)).inputs["fan"]
    assert (usual.min(), usual.max()) == (0.0, 65.0 if limits else 60.0)
    assert min(trial.inputs["fan"].min() for trial in found.rivals.values()) >= 0.0


def test_what_is_declared_stands_over_what_is_asked_for(tmp_path: Path) -> None:
    model = fan(tmp_path)
    asked, limited = ask(model, ranges=["fan=-10..60"]), ask(model, limits=["fan=5"])
    assert (asked.ranges, asked.limits) == ({"fan": (0.0, 60.0)}, {"fan": 40.0})  # from where it starts, at 20 %
    assert (limited.ranges, limited.limits) == ({"fan": (0.0, 100.0)}, {"fan": 5.0})
    with pytest.raises(InputError, match=r"0\.\.100 % for fan"):
        ask(model, ranges=["fan=-10..-5"])
    with pytest.raises(InputError, match=r"fan .*20.* --limit fan=VALUE"):
        ask(fan(tmp_path, ", (0.0, float('inf'))"))
