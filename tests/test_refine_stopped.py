"""A refine that is stopped leaves its results whole or not at all, and nothing else."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import Terminated
from cosim.estimation.subject import model_subject
from cosim.files.files import delay_stops, scratch_folder
from cosim.refinement import workflow
from cosim.verbs.cli import entry
from tests.test_refine_conditions import motor_study

CODES = {signal.SIGINT: 130, signal.SIGTERM: 4}


def terminate(number: int, frame: object) -> None:
    raise Terminated(signal.Signals(number).name)


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """As in a program, also where the suite runs in the background of a shell, which has it ignore the keyboard."""
    handlers = dict.fromkeys(CODES, terminate) | {signal.SIGINT: signal.default_int_handler}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = motor_study(tmp_path_factory.mktemp("motor"), 6.0)
    path.write_text(path.read_text() + "candidates: [fan]\n")
    return path


def stopped(study: Path, out: Path, monkeypatch: pytest.MonkeyPatch, at: str, number: signal.Signals) -> int:
    """Run `cosim refine` and stop it where a step of it begins; its exit code."""
    place = model_subject if hasattr(model_subject, at) else workflow
    step = getattr(place, at)

    def and_then(*arguments: Any, **more: Any) -> Any:
        signal.raise_signal(number)
        return step(*arguments, **more)

    monkeypatch.setattr(place, at, and_then)
    monkeypatch.setattr("sys.argv", ["cosim", "refine", str(study), "--out", str(out), "--no-report"])
    with pytest.raises(SystemExit) as left:
        entry()
    assert isinstance(left.value.code, int)
    return left.value.code


@pytest.mark.thorough
@pytest.mark.parametrize("number", CODES)
@pytest.mark.parametrize("at", ["attribute", "write_model", "noise_floor"])
def test_stopped_before_its_end_it_leaves_nothing(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, number: signal.Signals
) -> None:
    assert stopped(study, tmp_path / "out", monkeypatch, at, number) == CODES[number]
    assert not (tmp_path / "out").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.thorough
@pytest.mark.parametrize("number", CODES)
def test_stopped_while_results_move_to_their_place_it_leaves_all_of_them(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    assert stopped(study, tmp_path / "out", monkeypatch, "remove_earlier", number) == CODES[number]
    written = {"model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu", "refine.json"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == written


def test_a_signal_waits_for_what_must_be_whole_and_comes_then(tmp_path: Path) -> None:
    done = []

    def whole() -> None:
        with delay_stops():
            signal.raise_signal(signal.SIGINT)
            done.append(1)

    def half() -> None:
        with scratch_folder(tmp_path, ".part-") as scratch:
            (scratch / "half").write_text("…")
            signal.raise_signal(signal.SIGINT)
            done.append(2)

    for work in (whole, half):
        with pytest.raises(KeyboardInterrupt):
            work()
    assert done == [1]
    assert list(tmp_path.iterdir()) == []
