"""What the command line makes of odd files and odd terminals: an answer, never a traceback, never a wait."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.base.errors import InputError, Interrupted
from cosim.master.remote import SteppedRun
from cosim.refinement.stages import ORDER, stage_number
from cosim.refinement.study import read_study
from cosim.verbs.check_verb import check as check_files
from cosim.verbs.cli import app, entry
from cosim.verbs.terminal import Manner, stages
from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario
from tests.logs import times, write_log


def faults_of(*files: Path) -> list[str]:
    with pytest.raises(InputError) as refused:
        check_files(files)
    return [str(f) for f in refused.value.faults]


@pytest.mark.thorough
@pytest.mark.parametrize("encoding", ["cp1252", "latin-1", "utf-8"])
def test_any_terminal_can_be_written_to(tmp_path: Path, encoding: str) -> None:
    time = times(12.0)
    commands = {n: np.sin(time) for n in ("duty_right", "duty_left", "tilt_right", "tilt_left")}  # down to −1
    log = write_log(tmp_path / "a.csv", {"time": time, **commands, "ax": np.cos(time)})
    run = subprocess.run(
        [sys.executable, "-m", "cosim", "check", str(log)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": encoding},
        capture_output=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr
    assert ("−1.00" if encoding == "utf-8" else "\\u22121.00") in run.stdout.decode(encoding)


@pytest.mark.parametrize("name", ["a.csv", "study.yaml", "plant.fmu", "log"])
def test_a_pipe_is_no_file_and_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    assert faults_of(tmp_path / name) == [f"{tmp_path / name}: is no file"]
    with pytest.raises(InputError, match="is no file"):
        read_study(tmp_path / name)


@pytest.mark.parametrize("text", ["model: base\nnoise: {}\n", "candidates: [mass]\n"])
def test_a_study_without_logs_is_told_what_a_study_lacks(tmp_path: Path, text: str) -> None:
    (tmp_path / "study.yaml").write_text(text)
    assert faults_of(tmp_path / "study.yaml") == [f'{tmp_path / "study.yaml"}:1:1: "logs" is missing; add it']


def test_an_answer_is_no_study(tmp_path: Path) -> None:
    (tmp_path / "refine.json").write_text('{"study": "study.yaml", "verdict": "no_effect", "candidates": []}')
    (line,) = faults_of(tmp_path / "refine.json")
    assert "refine.json: is an answer of `cosim refine`, in which there is nothing to check: `cosim excite " in line
    assert line.endswith("check the study or model.yaml beside it")


def test_what_is_faulty_in_a_study_does_not_hide_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(
        "noise: {psi: 0, psy: 1}\ncandidates: [masss]\nlogs:\n  estimation: [none.csv]\n  validaton: [b.csv]\n"
    )
    told_of = [line.removeprefix(f"{tmp_path}/").partition(";")[0] for line in faults_of(path)]
    assert told_of == [
        "study.yaml:1:14: noise.psi is 0: it should be greater than 0",
        'study.yaml:1:17: no output "psy"',
        'study.yaml:2:14: no candidate "masss"',
        "study.yaml:4:16: none.csv: no such file beside the study",
        'study.yaml:5:3: unknown key "validaton"',
    ]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("model: 5\nnoise: {speed: 0}\n", "1:8: model is 5"),  # of which model are the names?
        ("modle: own.yaml\nnoise: {speed: 0}\n", '1:1: unknown key "modle"'),
    ],
)
def test_nothing_is_guessed_of_a_study_whose_model_is_not_known(tmp_path: Path, text: str, line: str) -> None:
    (tmp_path / "study.yaml").write_text(f"{text}logs: {{estimation: [none.csv]}}\n")
    first, second = faults_of(tmp_path / "study.yaml")
    assert first.startswith(f"{tmp_path / 'study.yaml'}:{line}")
    assert second.startswith(f"{tmp_path / 'study.yaml'}:2:16: noise.speed is 0")


def test_a_list_with_a_faulty_item_moves_no_place(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text("candidates: [[], masss]\nlogs: {estimation: [none.csv]}\n")
    item, missing = faults_of(tmp_path / "study.yaml")
    assert "study.yaml:1:14: candidates.0 is a list" in item
    assert "study.yaml:2:21: none.csv: no such file" in missing


@pytest.mark.parametrize(("share", "counted"), [(0.0, False), (0.4, True), (1.0, False)])
def test_a_stage_that_has_counted_to_its_end_shows_no_full_bar(
    monkeypatch: pytest.MonkeyPatch, share: float, counted: bool
) -> None:
    from rich import progress

    bars: list[progress.Progress] = []

    class Watched(progress.Progress):
        def __enter__(self) -> Watched:
            bars.append(self)
            return self

    monkeypatch.setattr(progress, "Progress", Watched)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with stages() as report:
        assert report is not None
        report("fitting", 0.9)
        report("fitting", share)
        (task,) = bars[0].tasks
        assert (task.total is not None) is counted  # without one the bar only moves
        assert not task.finished


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text there")
@pytest.mark.parametrize(
    ("name", "cure"),
    [(b"o_\xfc", "is not UTF-8 text"), ("o_ü".encode(), "in the locale of this shell; set PYTHONUTF8=1")],
)
def test_a_name_that_is_no_text_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: bytes, cure: str
) -> None:
    monkeypatch.chdir(tmp_path)
    given = name.decode("ascii", "surrogateescape")  # as Python reads it where the locale is C
    monkeypatch.setattr(sys, "argv", ["cosim", "check", given, str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        entry()
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert cure in told
    assert told.count("\n") == 1


# -- streams and signals ---------------------------------------------------------------------------


KEYBOARD = """import os, signal, sys
from cosim.__main__ import main
def stop(*_):
    os.kill(os.getpid(), signal.SIGINT)
{made}
main()
"""
LOADING = "sys.meta_path.insert(0, type('Stops', (), {'find_spec': stop}))"
TELLING = "import cosim.verbs.cli; cosim.verbs.cli.entry = stop"


def listening() -> None:
    """Also where the suite runs in the background of a shell, which has its children ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.skipif(sys.platform == "win32", reason="a console sends its Ctrl-C to all that share it")
@pytest.mark.parametrize("loading", [True, False])
def test_stopped_from_the_keyboard_is_130_while_modules_load_and_while_the_end_is_told(loading: bool) -> None:
    script = KEYBOARD.format(made=LOADING if loading else TELLING)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, preexec_fn=listening,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no such shell")
@pytest.mark.parametrize(("streams", "said"), [("2>&-", "no fault in"), (">&- 2>&- <&-", ""), ("| true", "")])
def test_closed_streams_keep_no_command_from_its_work(tmp_path: Path, streams: str, said: str) -> None:
    fmu = deeds_fmu(tmp_path / "good.fmu")
    shell = f"set -o pipefail; {sys.executable} -m cosim check {fmu.name} {streams}"  # `true` reads nothing and ends
    done = subprocess.run(
        ["bash", "-c", shell], cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert said in done.stdout


def test_a_check_that_is_stopped_tells_no_fault_and_checks_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked = []

    def interrupted(worker: object, system: object, *rest: object) -> SteppedRun:
        checked.append(system)
        return SteppedRun(None, (), Interrupted("the run", 0.0, "interrupted"))  # type: ignore[arg-type]

    monkeypatch.setattr("cosim.simulation.trial.simulate_in", interrupted)
    path = str(deeds_scenario(tmp_path, "none", "none"))
    answer = CliRunner().invoke(app, ["check", path, path, str(tmp_path / "none.yaml")])
    assert (answer.exit_code, answer.output, len(checked)) == (130, "", 1)


def test_a_stage_is_numbered_and_its_number_never_falls(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cosim.verbs.terminal.MANNER", Manner(verbose=True))
    told = [
        "reading the logs",
        "weighing what was found",
        "replacing each part",
        "replacing each part: candidate 1 of 2",
    ]
    with stages(stage_number) as report:
        assert report is not None
        for words in told:
            report(words, 0.5 if "candidate" in words else 0.0)
    lines = [line.split("s  ")[1] for line in capsys.readouterr().err.splitlines()]
    n = len(ORDER)
    assert lines == [f"stage {k} of {n}: {words}" for k, words in zip((1, 4, 4), told, strict=False)]


def test_every_stage_that_a_refine_tells_has_its_number() -> None:
    files = (ROOT / "cosim" / "refinement").rglob("*.py")
    sources = [p.read_text() for p in files if p.name != "stages.py"]
    told = {words for text in sources for words in re.findall(r'progress\("([^"]+)"', text)}
    told |= {words for text in sources for words in re.findall(r'_each\("([^"]+)"', text)}
    listed = {words for stage in ORDER for words in stage}
    assert told <= listed
    assert all(any(f'"{words}"' in text for text in sources) for words in listed)


@pytest.mark.parametrize("verb", [["check", "--model", "base"], ["replay"]])
def test_a_log_of_another_model_is_told_how_to_name_it(tmp_path: Path, verb: list[str]) -> None:
    log = tmp_path / "mine.csv"
    log.write_text("time,inflow,level\n" + "".join(f"{k},{k % 3},1.0\n" for k in range(30)))
    run = CliRunner().invoke(app, [*verb, str(log)])
    assert isinstance(run.exception, InputError)
    (fault,) = run.exception.faults
    assert "mine.csv:1:1: holds none of the columns of the model" in str(fault)
    assert "--model FILE:CLASS" in str(fault)
    assert "--plant FMU" in str(fault)
