"""A refine that is stopped leaves its results whole or not at all, and nothing else."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.cli import entry
from cosim.files import scratch_folder, uninterrupted
from cosim.refinement import workflow
from tests.test_refine_conditions import motor_study

CODES = {signal.SIGINT: 130, signal.SIGTERM: 4}


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """Also where the suite runs in the background of a shell, which has it ignore the keyboard."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = motor_study(tmp_path_factory.mktemp("motor"), 6.0)
    path.write_text(path.read_text() + "candidates: [fan]\n")
    return path


def stopped(study: Path, out: Path, monkeypatch: pytest.MonkeyPatch, at: str, number: signal.Signals) -> int:
    """Run `cosim refine` and stop it where a step of it begins; its exit code."""
    step = getattr(workflow, at)

    def and_then(*arguments: Any) -> Any:
        signal.raise_signal(number)
        return step(*arguments)

    monkeypatch.setattr(workflow, at, and_then)
    monkeypatch.setattr("sys.argv", ["cosim", "refine", str(study), "--out", str(out), "--no-report"])
    with pytest.raises(SystemExit) as left:
        entry()
    assert isinstance(left.value.code, int)
    return left.value.code


@pytest.mark.parametrize("number", CODES)
@pytest.mark.parametrize("at", ["attributed", "write_model", "noise_floor"])
def test_stopped_before_its_end_it_leaves_nothing(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, number: signal.Signals
) -> None:
    assert stopped(study, tmp_path / "out", monkeypatch, at, number) == CODES[number]
    assert not (tmp_path / "out").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", CODES)
def test_stopped_while_results_move_to_their_place_it_leaves_all_of_them(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    assert stopped(study, tmp_path / "out", monkeypatch, "_publish", number) == CODES[number]
    written = {"model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu", "refine.json"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == written


def test_a_signal_waits_for_what_must_be_whole_and_comes_then(tmp_path: Path) -> None:
    done = []

    def whole() -> None:
        with uninterrupted():
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


def test_where_no_signal_can_come_nothing_waits(tmp_path: Path) -> None:
    seen = []

    def work() -> None:
        with scratch_folder(tmp_path, ".part-") as scratch:
            seen.append(scratch.is_dir())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [True]
    assert list(tmp_path.iterdir()) == []
