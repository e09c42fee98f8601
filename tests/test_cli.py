"""The command line with unusual files and terminals: it responds with a message, without a traceback or a hang."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.verbs.checks import check as check_files
from cosim.verbs.cli import entry
from tests.deeds import deeds_fmu
from tests.logs import times, write_log
from tests.users import ENVIRONMENT


@pytest.mark.thorough
@pytest.mark.parametrize(("encoding", "minus"), [("cp1252", "\\u2212"), ("utf-8", "−")])
def test_any_terminal_can_be_written_to(tmp_path: Path, encoding: str, minus: str) -> None:
    time = times(12.0)
    commands = dict.fromkeys(("duty_right", "duty_left", "tilt_right", "tilt_left"), np.sin(time))  # down to −1
    log = write_log(tmp_path / "a.csv", {"time": time, **commands, "ax": np.cos(time)})
    words = [sys.executable, "-m", "cosim", "check", str(log)]
    done = subprocess.run(words, env=ENVIRONMENT | {"PYTHONIOENCODING": encoding}, capture_output=True, check=True)
    assert f"{minus}1.00" in done.stdout.decode(encoding)


@pytest.mark.parametrize(
    ("name", "text", "places"),
    [
        ("study.yaml", "model: base\nnoise: {}\n", [(1, 1)]),  # without logs
        ("refine.json", '{"study": "study.yaml", "verdict": "no_effect", "candidates": []}', [(0, 0)]),  # an answer
        (
            "study.yaml",
            "noise: {psi: 0, psy: 1}\ncandidates: [masss]\nlogs:\n  estimation: [none.csv]\n  validaton: [b.csv]\n",
            [(1, 14), (1, 17), (2, 14), (4, 16), (5, 3)],  # psi 0, psy, masss, none.csv, validaton
        ),
    ],
)
def test_all_that_is_faulty_in_a_study_is_told_at_its_place(
    tmp_path: Path, name: str, text: str, places: list[tuple[int, int]]
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as refused:
        check_files([tmp_path / name])
    assert [(f.line, f.column) for f in refused.value.faults] == places


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text there")
def test_a_name_that_is_no_text_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    given = b"o_\xfc".decode("ascii", "surrogateescape")
    monkeypatch.setattr(sys, "argv", ["cosim", "check", given, str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        entry()
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


# -- streams and signals ---------------------------------------------------------------------------


KEYBOARD = """import os, signal, sys
from cosim.__main__ import main
def stop(*_):
    os.kill(os.getpid(), signal.SIGINT)
{made}
main()
"""


def listening() -> None:
    """Also where the suite runs in the background of a shell, which has its children ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.skipif(sys.platform == "win32", reason="a console sends its Ctrl-C to all that share it")
@pytest.mark.parametrize(
    "made",
    [
        "sys.meta_path.insert(0, type('Stops', (), {'find_spec': stop}))",  # while modules load
        "import cosim.verbs.cli; cosim.verbs.cli.entry = stop",  # while the end is told
    ],
)
def test_stopped_from_the_keyboard_is_130_at_any_time(made: str) -> None:
    words = [sys.executable, "-c", KEYBOARD.format(made=made)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, preexec_fn=listening, env=ENVIRONMENT)
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="no such shell")
@pytest.mark.parametrize(("streams", "said"), [("2>&-", "no faults in"), (">&- 2>&- <&-", ""), ("| true", "")])
def test_closed_streams_keep_no_command_from_its_work(tmp_path: Path, streams: str, said: str) -> None:
    fmu = deeds_fmu(tmp_path / "good.fmu")
    shell = f"set -o pipefail; {sys.executable} -m cosim check {fmu} {streams}"  # `true` reads nothing and ends
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, timeout=60, env=ENVIRONMENT)
    assert (done.returncode, done.stderr) == (0, "")
    assert said in done.stdout


THREADS = """
import os, sys
os.environ.pop("OPENBLAS_NUM_THREADS", None)
from cosim import __main__ as program
assert "numpy" not in sys.modules
sys.argv = ["cosim", "compare", "a.csv", "b.csv"]
try:
    program.main()
finally:
    print("threads:", os.environ["OPENBLAS_NUM_THREADS"], "numpy" in sys.modules)
"""


def test_threads_of_linear_algebra_are_limited_before_numpy_is_imported() -> None:
    """To one, because fits run side by side."""
    done = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, env=ENVIRONMENT)
    assert "threads: 1 True" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("cosim op", ["open"]),
        ("cosim open ta", ["tank/0001"]),
        ("cosim compare tank ", ["tank/0001", "1"]),
        ("cosim view --col", ["--column"]),
        ("cosim schema sw", ["sweep"]),
    ],
)
def test_a_shell_completes_verbs_options_runs_and_kinds(tmp_path: Path, line: str, found: list[str]) -> None:
    (run := tmp_path / "results" / "tank" / "0001").mkdir(parents=True)
    (run / "manifest.json").write_text('{"status": "ok", "scenario": {}}')
    (run / "results.csv").write_text("time,x\n0,1\n")
    asked = {"_COSIM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    done = subprocess.run(
        [Path(sys.executable).with_name("cosim")],
        cwd=tmp_path,
        env=ENVIRONMENT | asked,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == found
