"""Robustness of verdicts: superfluous effects in the model, sensor errors together with effects, protected inputs.

A stopped refine writes either all of its results or none.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError, Terminated
from cosim.estimation.subject import model_subject
from cosim.experiment.excite import excite
from cosim.fmi.building.file import read_model
from cosim.refinement import workflow
from cosim.refinement.workflow import refine
from cosim.simulation.workflow import run
from cosim.verbs.cli import entry
from plant.hovercraft import Hovercraft
from tests.studies import holds, named, study_of
from tests.studies import proven as flown
from tests.test_refine_conditions import motor_study, with_candidates

pytestmark = pytest.mark.optimized


@pytest.mark.thorough
@pytest.mark.xfail(strict=True, reason="ambiguous: the mass has 94.8 %")
def test_a_mass_of_four_percent_more_is_no_nothing(tmp_path: Path) -> None:
    """The prior of the base parameters takes it up; the model as it stands is off by several times the noise."""
    truth = 1.04 * Hovercraft().mass
    r = flown(study_of(tmp_path / "study", {"mass": {"value": truth}}), tmp_path / "out")
    assert (r.record["verdict"], named(r)) == ("parameter_error", {"mass"})
    assert holds(r, "mass", "value", truth)


@pytest.mark.thorough
def test_what_recalibration_explains_is_in_the_nearest_model_where_no_candidate_is_it(tmp_path: Path) -> None:
    truth = 1.1 * Hovercraft().mass
    study = study_of(tmp_path / "study", {"mass": {"value": truth}})
    r = flown(with_candidates(study, "coriolis, gyro_bias"), tmp_path / "out")
    assert (r.record["verdict"], r.record["nearest"]) == ("no_effect", [])
    assert read_model(r.folder / "nearest.yaml").parameters["mass"] == pytest.approx(truth, rel=0.01)


@pytest.mark.thorough
def test_an_effect_that_the_model_has_too_much_of_is_taken_out(tmp_path: Path) -> None:
    study = with_candidates(study_of(tmp_path / "study", {}), "coulomb_friction, yaw_damping, table_tilt")
    parameters = "{coulomb_friction.force: 0.05, yaw_damping.coefficient: 0.006}"
    text = f"schema_version: 1\nmodel: hovercraft\nparameters: {parameters}\n"
    study.with_name("model.yaml").write_text(text)
    study.write_text(study.read_text().replace("model: base", "model: model.yaml"))
    r = flown(study, tmp_path / "out")
    assert (r.record["verdict"], named(r)) == ("parameter_error", {"coulomb_friction", "yaw_damping"})


def test_what_is_read_is_not_written_over(project: Path) -> None:
    study = motor_study(project, 6.0)
    study.write_text(study.read_text().replace("motor.py:Motor", "model.yaml"))
    (project / "base.yaml").write_text("model: base\nlogs: {estimation: [a.csv]}\n")
    record = f'{{"study": "{project}/base.yaml", "rivals": [], "candidates": [], "hidden": [], "measured": ["psi"]}}'
    (project / "played.yaml").write_text(
        "name: played\nduration: 1\nstep: 0.02\ncomponents:\n"
        "  plant: {fmu: build/plant.fmu}\n  told: {block: playback, file: results.csv}\n"
        "connections:\n  - {from: told.force, to: plant.tilt_right}\n"
    )
    for name, content, call in (
        (
            "model.yaml",
            "schema_version: 1\nmodel: motor.py:Motor\nparameters: {k: 0.05}\n",
            lambda: refine(study, project),
        ),
        ("results.csv", "time,force\n0,0\n1,1\n", lambda: run(project / "played.yaml", project, force=True)),
        ("refine.json", record, lambda: excite(str(project), project, ["yaw_damping", "coriolis"], force=True)),
    ):
        (project / name).write_text(content)
        (project / "plant.fmu").write_text("refined")
        with pytest.raises(InputError, match="--out") as refused:
            call()
        assert refused.value.exit_code == 2
        assert (project / name).read_text() == content
        assert (project / "plant.fmu").read_text() == "refined"


# -- signals ----------------------------------------------------------------------------------

CODES = {signal.SIGINT: 130, signal.SIGTERM: 4}
FILES = {"model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu", "refine.json"}


def terminate(number: int, frame: object) -> None:
    raise Terminated(signal.Signals(number).name)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """As in a program, also where the suite runs in the background of a shell, which has it ignore the keyboard."""
    handlers = dict.fromkeys(CODES, terminate) | {signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("at", "number"),
    [
        ("attribute", signal.SIGINT),
        ("attribute", signal.SIGTERM),
        ("write_model", signal.SIGTERM),
        ("noise_floor", signal.SIGINT),
        ("remove_earlier", signal.SIGINT),  # while results move to their place
        ("remove_earlier", signal.SIGTERM),
    ],
)
@pytest.mark.usefixtures("interruptible")
def test_stopped_where_a_step_of_it_begins_it_leaves_its_results_or_the_earlier_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, number: signal.Signals
) -> None:
    study, out = motor_study(tmp_path, 6.0), tmp_path / "out"
    study.write_text(study.read_text() + "candidates: [fan]\n")
    out.mkdir()
    for name in FILES:
        (out / name).write_text("earlier")
    place = model_subject if hasattr(model_subject, at) else workflow
    step = getattr(place, at)

    def and_then(*arguments: Any, **more: Any) -> Any:
        signal.raise_signal(number)
        return step(*arguments, **more)

    monkeypatch.setattr(place, at, and_then)
    monkeypatch.setattr("sys.argv", ["cosim", "refine", str(study), "--out", str(out), "--no-report", "--force"])
    with pytest.raises(SystemExit) as left:
        entry()
    assert left.value.code == CODES[number]
    assert {p.name for p in out.iterdir()} == FILES
    assert [p.read_bytes() == b"earlier" for p in out.iterdir()] == [at != "remove_earlier"] * len(FILES)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
