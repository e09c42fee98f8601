"""What every command has on a terminal and in a script: -h, -q, -v, --json alone on stdout, also of a failure."""

from __future__ import annotations

import inspect
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer.main
from typer.testing import CliRunner

from cosim.files.folders import runs_named
from cosim.verbs.cli import command_line, entry
from tests.cart import cart_fmu
from tests.deeds import deeds_scenario
from tests.logs import times, write_log
from tests.tank import MODEL as TANK
from tests.typed import typed_fmu

COMMANDS = typer.main.get_command(command_line()).commands  # type: ignore[attr-defined]
WITHOUT_FILES = {"bench", "consistency", "gc", "list", "open", "schema"}  # some print JSON alone
ASKED = {"build": ["--model"], "compare": ["none.csv"], "fit": ["--fmu", "none.fmu"]}


SCENARIO = """
name: my tank
duration: 1
step: 0.1
components: {r: {block: reference, signals: {x: {start: 1}}}}
"""
Told = Callable[..., tuple[int, str, str]]


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Told:
    """A function that runs a command in the temporary folder, and returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["cosim", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            entry()
        return int(ended.value.code or 0), *capfd.readouterr()

    return run


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_quiet_verbose_and_an_example_that_its_parser_takes(command: str) -> None:
    done = CliRunner().invoke(command_line(), [command, "-h"])
    assert done.exit_code == 0
    for option in ("-q", "-v", "-h", *(("--json",) if command not in {"bench", "schema"} else ())):
        assert option in done.output, option
    parsed = COMMANDS[command]
    assert all(parameter.help for parameter in parsed.params)
    _, _, example = inspect.cleandoc(parsed.help).partition("Example: cosim ")
    name, *arguments = shlex.split(example)
    assert name == command
    parsed.make_context(command, arguments)


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - WITHOUT_FILES))
def test_json_of_a_failure_is_alone_on_stdout(tmp_path: Path, told: Told, command: str) -> None:
    code, out, err = told(command, *ASKED.get(command, []), "none.yaml", "--json")
    found = json.loads(out)
    assert (code, found["exit_code"]) == (2, 2)
    assert found["error"] in err
    assert found["faults"][0]["file"].startswith("none.")
    assert list(tmp_path.iterdir()) == []


def test_json_of_what_is_done_is_alone_on_stdout(told: Told) -> None:
    Path("tank.py").write_text(TANK)
    Path("s.yaml").write_text(SCENARIO)
    expected = {
        ("check", "s.yaml"): {"files": ["s.yaml"], "findings": [], "faults": []},
        ("graph", "s.yaml"): {"graph": "s.svg"},
        ("build", "--model", "tank.py:Tank", "--out", "b"): {"built": [{"fmu": "b/plant.fmu"}]},
    }
    for command, content in expected.items():
        code, out, _ = told(*command, "--json")
        assert code == 0
        assert json.loads(out) == content
    code, out, _ = told("run", "s.yaml", "--in-process", "--json", "--no-report")
    assert (code, json.loads(out)["results"]) == (0, "results/my-tank/0001/results.csv")
    code, out, _ = told("report", "results/my-tank", "--json")
    assert (code, json.loads(out)) == (0, {"report": "results/my-tank/0001/report.html"})


@pytest.mark.parametrize("words", [["run"], ["info", "--bogus"], ["frobnicate"], ["run", "a", "b"]])
def test_json_of_wrong_usage_is_alone_on_stdout(told: Told, words: list[str]) -> None:
    code, out, err = told(*words, "--json")
    found = json.loads(out)
    assert (code, found["exit_code"]) == (2, 2)
    assert [(f["kind"], f["message"]) for f in found["faults"]] == [("UsageError", found["error"])]
    assert found["error"] in err
    code, out, _ = told(*words)
    assert (code, out) == (2, "")


# -- folders ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "folder"),
    [("a b", "a-b"), ("../up", "_up"), (" ", "run"), ("a/b", "a_b"), ("Größe 2", "Größe-2"), ("x" * 300, "x" * 100)],
)
def test_a_folder_of_results_has_a_name_without_blanks_within_results(name: str, folder: str) -> None:
    assert runs_named(name) == Path("results") / folder


@pytest.mark.parametrize(
    "command", ["run s.yaml", "build --model tank.py:Tank", "linearize tank.py:Tank", "excite tank.py:Tank"]
)
@pytest.mark.parametrize("place", ["taken", "taken/within"])
def test_a_file_where_the_folder_should_be_is_told(told: Told, command: str, place: str) -> None:
    Path("tank.py").write_text(TANK)
    Path("s.yaml").write_text(SCENARIO)
    Path("taken").touch()
    here = ["--in-process"] if command.startswith("run") else []
    code, out, err = told(*command.split(), "--out", place, *here)
    assert (code, out) == (2, "")
    assert err == f"{place}: cannot be the folder for results: taken is a file; give a folder as --out\n"
    assert Path("taken").is_file()


def test_a_command_to_go_on_with_can_be_pasted_whatever_the_names(tmp_path: Path, told: Told) -> None:
    fmu = typed_fmu(tmp_path).rename("Größe 1.fmu")
    code, out, _ = told("init", fmu, "--out", "mein fall.yaml")
    assert code == 0
    assert "cosim run 'mein fall.yaml'" in out
    assert "Groesse_1:" in Path("mein fall.yaml").read_text()
    assert told("init", fmu, "--out", tmp_path)[0] == 2


def test_linearize_leaves_results_of_its_own_and_refuses_those_of_another(told: Told) -> None:
    Path("tank.py").write_text(TANK)
    code, out, _ = told("linearize", "tank.py:Tank", "--no-report")
    assert code == 0
    place = Path("results") / "Tank-linear" / "0001"
    assert f"linear model: {place}/linear.json" in out
    assert "report" not in out
    code, _, err = told("linearize", "bench", "--out", place, "--no-report")
    assert (code, err.count("--force")) == (2, 1)
    assert told("linearize", "bench", "--out", place, "--no-report", "--force")[0] == 0


# -- what --json tells a script -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("criteria", "code", "status", "met"),
    [
        ("{peak: {of: r.x, max: 2}}", 0, "ok", True),
        ("{peak: [{of: r.x, max: 2}, {of: r.x, max: 0.5}]}", 5, "missed", False),
        ("{}", 0, "ok", None),
    ],
)
def test_a_script_reads_from_json_whether_all_criteria_were_met(
    told: Told, criteria: str, code: int, status: str, met: bool | None
) -> None:
    Path("s.yaml").write_text(f"{SCENARIO}criteria: {criteria}\n")
    ended, out, _ = told("run", "s.yaml", "--out", "o", "--no-report", "--in-process", "--json")
    said = json.loads(out)
    assert (ended, said["exit_code"], said["status"], said["met"]) == (code, code, status, met)
    assert json.loads(Path("o/manifest.json").read_text())["status"] == "ok"  # it came to its end


@pytest.mark.skipif(sys.platform == "win32", reason="its crashes go by other names")
def test_json_of_a_failed_run_says_who_when_why_and_what_is_left(tmp_path: Path, told: Told) -> None:
    scenario = deeds_scenario(tmp_path, "DoStep", "abort", 5)
    code, out, _ = told("run", scenario, "--out", "out", "--no-report", "--json")
    said = json.loads(out)
    assert (code, said["exit_code"], said["status"], said["component"]) == (4, 4, "failed", "bad")
    assert said["time"] == pytest.approx(0.4)
    assert "crashed" in said["reason"]
    assert (said["results"], said["manifest"], said["report"]) == ("out/results.csv", "out/manifest.json", None)


def test_json_of_a_replay_holds_its_numbers(tmp_path: Path, told: Told) -> None:
    fmu, time = cart_fmu(tmp_path, starts=0), times(4.0)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    log = write_log(tmp_path / "cart.csv", {"time": time, "force": 0.0 * time, "position": 0.5 + noise})
    code, out, _ = told("replay", log, "--fmu", fmu, "--out", "o", "--no-report", "--json")
    assert code == 0
    (position,) = json.loads(out)["channels"]
    assert (position["name"], position["horizon"], position["rows"]) == ("position", None, time.size)
    assert position["rmse"] == pytest.approx(0.5, rel=1e-3)  # the FMU stays at 0
    assert position["rmse"] == position["free_run"]["rmse"]
    assert position["fit"] < 0
    assert position["explained"] is False


def test_json_of_a_linear_model_and_of_faults(told: Told) -> None:
    Path("tank.py").write_text(TANK)
    code, out, _ = told("linearize", "tank.py:Tank", "--at", "level=1", "--json", "--out", "o")
    content = json.loads(out)
    assert (code, content["models"][0]["A"]) == (0, [[-0.02]])
    assert content["structure"]["poles"][0]["real"] == -0.02
    Path("tank.py").write_text(TANK.replace("m.maximum(level, 1e-6)", "level"))
    assert told("linearize", "tank.py:Tank", "--at", "level=-1", "--out", "n")[0] == 4  # the square root
    assert not Path("n").exists()
    code, out, _ = told("linearize", "tank.py:Tank", "--at", "a=1,b=1", "--json")
    assert [(f["kind"], f["file"]) for f in json.loads(out)["faults"]] == [("InputError", None)] * 2
