"""Common options of all commands: -h, -q, -v, and --json with only JSON on stdout, also after a failure."""

from __future__ import annotations

import inspect
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from cosim.files.folders import runs_named
from cosim.verbs.cli import command_line, entry
from tests.deeds import deeds_scenario
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
    for words, content in (
        ("check s.yaml", {"files": ["s.yaml"], "findings": [], "faults": []}),
        ("graph s.yaml", {"graph": "s.svg"}),
        ("build --model tank.py:Tank --out b", {"built": [{"fmu": "b/plant.fmu"}]}),
        ("run s.yaml --in-process --no-report", {"results": "results/my-tank/0001/results.csv"}),
        ("report results/my-tank", {"report": "results/my-tank/0001/report.html"}),
    ):
        code, out, _ = told(*words.split(), "--json")
        assert code == 0
        assert json.loads(out).items() >= content.items()


@pytest.mark.parametrize("words", [["run"], ["info", "--bogus"], ["frobnicate"]])
def test_json_of_wrong_usage_is_alone_on_stdout(told: Told, words: list[str]) -> None:
    code, out, err = told(*words, "--json")
    found = json.loads(out)
    assert (code, found["exit_code"]) == (2, 2)
    assert [(f["kind"], f["message"]) for f in found["faults"]] == [("UsageError", found["error"])]
    assert found["error"] in err
    assert told(*words)[:2] == (2, "")


# -- folders ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "folder"),
    [("../up", "_up"), (" ", "run"), ("a/b", "a_b"), ("Größe 2", "Größe-2"), ("x" * 300, "x" * 100)],
)
def test_a_folder_of_results_has_a_name_without_blanks_within_results(name: str, folder: str) -> None:
    assert runs_named(name) == Path("results") / folder


def test_a_command_to_go_on_with_can_be_pasted_whatever_the_names(tmp_path: Path, told: Told) -> None:
    code, out, _ = told("init", typed_fmu(tmp_path).rename("Größe 1.fmu"), "--out", "mein fall.yaml")
    assert code == 0
    assert "cosim run 'mein fall.yaml'" in out
    assert "Groesse_1:" in Path("mein fall.yaml").read_text()


# -- what --json tells a script -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("criteria", "code", "status", "met"),
    [
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


def test_json_of_a_linear_model_and_of_a_model_that_has_none(told: Told) -> None:
    Path("tank.py").write_text(TANK.replace("m.maximum(level, 1e-6)", "level"))
    code, out, _ = told("linearize", "tank.py:Tank", "--at", "level=1", "--json", "--out", "o")
    assert (code, json.loads(out)["models"][0]["A"]) == (0, [[-0.02]])
    assert told("linearize", "tank.py:Tank", "--at", "level=-1", "--out", "n")[0] == 4  # the square root
    assert not Path("n").exists()
