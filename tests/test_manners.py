"""What every command has on a terminal and in a script: -h, -q, -v, --json alone on stdout, also of a failure."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.storage.folders import name_of, name_of_file, runs_named
from cosim.verbs.cli import app, entry
from tests.tank import MODEL as TANK
from tests.typed import typed_fmu

COMMANDS = sorted(c.name or c.callback.__name__ for c in app.registered_commands if c.callback)
WITHOUT_FILES = {"bench", "consistency", "gc", "list", "open", "schema"}  # some print JSON alone
ASKED = {"build": ["--model"], "compare": ["none.csv"], "fit": ["--fmu", "none.fmu"]}


def told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str | Path
) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    monkeypatch.setattr("sys.argv", ["cosim", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        entry()
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_quiet_and_verbose(command: str) -> None:
    done = CliRunner().invoke(app, [command, "-h"])
    assert done.exit_code == 0
    for option in ("-q", "-v", "-h", *(("--json",) if command not in {"bench", "schema"} else ())):
        assert option in done.output, option


@pytest.mark.parametrize("command", sorted(set(COMMANDS) - WITHOUT_FILES))
def test_json_of_a_failure_is_alone_on_stdout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = told(monkeypatch, capsys, command, *ASKED.get(command, []), "none.yaml", "--json")
    found = json.loads(out)
    assert (code, found["exit_code"]) == (2, 2)
    assert found["error"] in err
    assert found["faults"][0]["file"].startswith("none.")
    assert list(tmp_path.iterdir()) == []


def test_json_of_what_is_done_is_alone_on_stdout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tank.py").write_text(TANK)
    Path("s.yaml").write_text(
        "name: my tank\nduration: 1\nstep: 0.1\ncomponents: {r: {block: reference, signals: {x: {start: 1}}}}\n"
    )
    expected = {
        ("check", "s.yaml"): {"files": ["s.yaml"], "findings": [], "faults": []},
        ("graph", "s.yaml"): {"graph": "s.svg"},
        ("build", "--model", "tank.py:Tank", "--out", "b"): {"built": [{"fmu": "b/plant.fmu"}]},
    }
    for command, content in expected.items():
        code, out, _ = told(monkeypatch, capsys, *command, "--json")
        assert code == 0
        assert json.loads(out) == content
    code, out, _ = told(monkeypatch, capsys, "run", "s.yaml", "--in-process", "--json", "--no-report")
    assert (code, json.loads(out)["results"]) == (0, "results/my-tank/0001/results.csv")
    code, out, _ = told(monkeypatch, capsys, "report", "results/my-tank", "--json")
    assert (code, json.loads(out)) == (0, {"report": "results/my-tank/0001/report.html"})


@pytest.mark.parametrize("words", [["run"], ["info", "--bogus"], ["frobnicate"], ["run", "a", "b"]])
def test_json_of_wrong_usage_is_alone_on_stdout(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    code, out, err = told(monkeypatch, capsys, *words, "--json")
    found = json.loads(out)
    assert (code, found["exit_code"], found["faults"]) == (2, 2, [])
    assert found["error"] in err
    code, out, _ = told(monkeypatch, capsys, *words)
    assert (code, out) == (2, "")


# -- folders ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "folder"),
    [("a b", "a-b"), ("../up", "_up"), (" ", "run"), ("a/b", "a_b"), ("Größe 2", "Größe-2"), ("x" * 300, "x" * 100)],
)
def test_a_folder_of_results_has_a_name_without_blanks_within_results(name: str, folder: str) -> None:
    assert runs_named(name) == Path("results") / folder


def test_results_are_called_after_what_they_are_of(tmp_path: Path) -> None:
    assert name_of_file(Path("logs/flight 1.csv"), "fit") == "flight 1-fit"
    assert name_of_file(tmp_path / "results.csv") == f"{tmp_path.name}-replayed"
    assert name_of_file(tmp_path / "0003" / "results.csv") == f"{tmp_path.name}-replayed"
    (tmp_path / "refine.json").touch()
    names = {name_of(text) for text in (str(tmp_path), f"{tmp_path}/refine.json", f"{tmp_path}/model.yaml")}
    assert names == {tmp_path.name}
    assert [name_of(text) for text in ("base", "a/b.fmu", "a/tank.py:Tank")] == ["base", "b", "Tank"]


@pytest.mark.parametrize(
    "command", ["run s.yaml", "build --model tank.py:Tank", "linearize tank.py:Tank", "excite tank.py:Tank"]
)
@pytest.mark.parametrize("place", ["taken", "taken/within"])
def test_a_file_where_the_folder_should_be_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str, place: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tank.py").write_text(TANK)
    Path("s.yaml").write_text(
        "name: s\nduration: 1\nstep: 0.1\ncomponents: {r: {block: reference, signals: {x: {}}}}\n"
    )
    Path("taken").touch()
    here = ["--in-process"] if command.startswith("run") else []
    code, out, err = told(monkeypatch, capsys, *command.split(), "--out", place, *here)
    assert (code, out) == (2, "")
    assert err == f"{place}: cannot be the folder for results: taken is a file; give a folder as --out\n"
    assert Path("taken").is_file()


def test_a_command_to_go_on_with_can_be_pasted_whatever_the_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    fmu = typed_fmu(tmp_path).rename("Größe 1.fmu")
    code, out, _ = told(monkeypatch, capsys, "init", fmu, "--out", "mein fall.yaml")
    assert code == 0
    assert "cosim run 'mein fall.yaml'" in out
    assert "Groesse_1:" in Path("mein fall.yaml").read_text()
    assert told(monkeypatch, capsys, "init", fmu, "--out", tmp_path)[0] == 2


def test_linearize_leaves_results_of_its_own_and_refuses_those_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tank.py").write_text(TANK)
    code, out, _ = told(monkeypatch, capsys, "linearize", "tank.py:Tank", "--no-report")
    assert code == 0
    place = Path("results") / "Tank-linear" / "0001"
    assert f"linear model: {place}/linear.json" in out
    assert "report" not in out
    code, _, err = told(monkeypatch, capsys, "linearize", "bench", "--out", place, "--no-report")
    assert (code, err.count("--force")) == (2, 1)
    assert told(monkeypatch, capsys, "linearize", "bench", "--out", place, "--no-report", "--force")[0] == 0
