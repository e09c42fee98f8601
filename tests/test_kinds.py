"""Every command, given every kind of file that it does not read: what it is, who reads it, exit 2, nothing written."""

from __future__ import annotations

import json
import os
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.base.errors import CosimError
from cosim.storage.artefact import artefacts, kind_by_keys
from cosim.storage.kinds import BINARY, LOG, MODEL, RESULTS, SCENARIO, STUDY, kind_of
from cosim.storage.yaml_file import YamlFile
from cosim.verbs.cli import app, entry

SHORT = 400  # characters that are read before one gives up
WORDS = {  # file → what it is called
    "none.yaml": "no such",
    "plain": "is a folder",
    "ran": "is the folder of a run",
    "refined": "is the folder of a refine",
    "replayed": "is the folder of a replay",
    "empty.yaml": "is empty",
    "empty.csv": "is empty",
    "empty.fmu": "is empty",
    "pipe": "is no file",
    "log.csv": "is a log",
    "ran/results.csv": "is the rows of a run",
    "x.fmu": "is an FMU",
    "as.zip": "is an FMU",
    "x.ssp": "is an SSP",
    "scenario.yaml": "is a scenario",
    "ran/manifest.json": "is a manifest",
    "study.yaml": "is a study",
    "fit.yaml": "is a study of a fit",
    "sweep.yaml": "is a sweep",
    "protocol.yaml": "is a protocol of a testing bench",
    "model.yaml": "is a model file",
    "design.yaml": "is a design of controllers",
    "model.py": "is a model's Python file",
    "refined/refine.json": "is an answer of `cosim refine`",
    "linear.json": "is an answer of `cosim linearize`",
    "fit.json": "is an answer of `cosim fit`",
    "sweep.json": "is an answer of `cosim sweep`",
    "comparison.json": "is an answer of `cosim compare`",
    "replay.json": "is an answer of `cosim replay`",
    "identify.json": "is an answer of `cosim identify`",
    "consistency.json": "is an answer of `cosim consistency`",
    "runs.sqlite": "is a database",
    "view.json": "is a file of layouts",
    "schema.json": "is a JSON schema",
    "report.html": "is a page for a browser",
    "page.csv": "is a page for a browser",
    "graph.svg": "is a picture",
    "a.png": "is a picture",
    "a.ipynb": "is a notebook",
    "a.mat": "is a file of matrices",
    "a.xlsx": "is a workbook",
    "a.zip": "is an archive that holds no FMU",
    "sweep.parquet": "is a table of runs",
    "a.so": "is a compiled library",
    "a.pdf": "is a PDF",
    "README.md": "is a text",
    "notes.txt": "is a text",
    "modelDescription.xml": "is XML",
    "pointer.fmu": "is a pointer of Git LFS",
    "core": "is a binary file",
}
DESCRIBED = """<fmiModelDescription fmiVersion="2.0" modelName="x" guid="1"><CoSimulation modelIdentifier="x"/>
<ModelVariables/><ModelStructure/></fmiModelDescription>"""
SCENARIOS = {"scenario.yaml", "ran/manifest.json", "x.ssp"}
MODELS = {
    "model.yaml",
    "model.py",
    "refined",
    "refined/refine.json",
    "study.yaml",
    "fit.yaml",
}  # a study says which model it names
LOGS = {"log.csv", "ran/results.csv"}
FMUS = {"x.fmu", "as.zip"}
CHECKED = (
    SCENARIOS
    | FMUS
    | {"study.yaml", "fit.yaml", "sweep.yaml", "protocol.yaml", "model.yaml", "model.py", "log.csv"}
    | {"design.yaml"}
)
READ = {  # command → what it reads
    "run": SCENARIOS,
    "graph": SCENARIOS,
    "export-ssp": SCENARIOS,
    "check": CHECKED,
    "replay": LOGS,
    "replay log.csv --plant": FMUS,
    "fit --fmu x.fmu": LOGS,
    "fit log.csv --fmu": FMUS,
    "fit": LOGS | {"study.yaml", "fit.yaml"},
    "refine": {"study.yaml"},
    "excite": MODELS | FMUS,
    "linearize": (MODELS | FMUS) - {"study.yaml", "fit.yaml"},
    "build --model": MODELS,
    "identify": {"protocol.yaml"},
    "sweep": {"sweep.yaml"},
    "info": FMUS,
    "init": FMUS,
    "simulate": FMUS,
    "simulate x.fmu --input": LOGS,
    "compare log.csv": LOGS | {"ran", "replayed"},
    "report": {"ran"},
    "view": LOGS | {"ran", "replayed"},
}


def _archive(path: Path, *names: str) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(name, DESCRIBED)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one file of every kind."""
    folder = tmp_path_factory.mktemp("shelf")
    for name in ("plain", "ran", "refined", "replayed"):
        (folder / name).mkdir()
    answer = {"schema_version": 1}
    texts = {
        "empty.yaml": "", "empty.csv": "", "empty.fmu": "", "log.csv": "time,x\n0,0\n1,1\n",
        "ran/results.csv": "time,a.x\n0,1\n", "replayed/results.csv": "time,a.x\n0,1\n",
        "replayed/residual.csv": "time,x\n0,0\n",
        "scenario.yaml": "name: s\nduration: 1\nstep: 0.1\ncomponents: {a: {fmu: x.fmu}}\n",
        "ran/manifest.json": json.dumps({**answer, "scenario": {"name": "s", "components": {}}}),
        "study.yaml": "logs: {estimation: [log.csv]}\n",
        "fit.yaml": "model: x.fmu\nlogs: {estimation: [log.csv]}\nvary: [a]\n",
        "sweep.yaml": "scenario: scenario.yaml\nvary: {step: {}}\n",
        "protocol.yaml": "cells: {}\ntests: {}\n", "model.yaml": "parameters: {}\n", "model.py": "x = 1\n",
        "design.yaml": "R: [1, 1]\n",
        "refined/refine.json": '{"verdict": "no_effect", "candidates": []}',
        "linear.json": json.dumps({**answer, "model": "m", "states": [], "models": []}),
        "fit.json": json.dumps({**answer, "parameters": {}, "simulations": 1, "logs": []}),
        "sweep.json": json.dumps({**answer, "sweep": {"vary": {}}, "scenario": {}, "runs": 1}),
        "comparison.json": json.dumps({"a": "x", "b": "y", "tolerance": None, "within": None, "signals": []}),
        "replay.json": json.dumps({**answer, "units": {}}),
        "consistency.json": json.dumps({"runs": 2, "steps": 100, "seed": 1, "rows": []}),
        "identify.json": json.dumps({**answer, "estimates": {}, "tests": {}}),
        "view.json": json.dumps({**answer, "layouts": {}}),
        "schema.json": '{"$schema": "https://json-schema.org/draft/2020-12/schema", "properties": {}}',
        "report.html": "<!doctype html>\n<html>" + "<p>word</p>" * 300, "page.csv": "\n<HTML><body>not found",
        "graph.svg": '<svg xmlns="http://www.w3.org/2000/svg" aria-label="' + "a, " * 300 + '"/>',
        "a.ipynb": '{"cells": [], "nbformat": 4}', "README.md": "# Words: more\n\n- a: b\n",
        "notes.txt": "some words, and\nmore of them\n", "modelDescription.xml": '<?xml version="1.0"?>\n<fmi/>',
        "pointer.fmu": "version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n",
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_text(text)
    heads = {
        "a.png": b"\x89PNG\r\n\x1a\n\0\0", "a.mat": b"MATLAB 7.3 MAT-file, Platform: posix\0\1IM", "core": b"\1\0\3,",
        "sweep.parquet": b"PAR1\0PAR1", "a.so": b"\x7fELF\2\1\t", "a.pdf": b"%PDF-1.4\n\xff",
        "runs.sqlite": b"SQLite format 3\0",
    }  # fmt: skip
    for name, head in heads.items():
        (folder / name).write_bytes(head)
    _archive(folder / "x.fmu", "modelDescription.xml")
    _archive(folder / "as.zip", "modelDescription.xml", "a.txt")
    _archive(folder / "x.ssp", "SystemStructure.ssd")
    _archive(folder / "a.zip", "a.txt")
    _archive(folder / "a.xlsx", "xl/workbook.xml")
    os.mkfifo(folder / "pipe")
    return folder


def _refused(command: str, name: str) -> str:
    here = ["--in-process"] if command.split()[0] in {"run", "replay"} else []  # no worker has to be started
    out = ["--out", "made.yaml"] if command == "init" else []
    done = CliRunner().invoke(app, [*command.split(), name, *here, *out])
    assert isinstance(done.exception, CosimError), (done.exception, done.output)
    assert done.exception.exit_code == 2, done.exception
    lines = str(done.exception).splitlines()
    return "\n".join(line for line in lines if "no parameter to estimate" not in line)  # of x.fmu, by `cosim fit`


@pytest.mark.thorough
@pytest.mark.parametrize("command", READ)
def test_what_a_command_does_not_read_is_named_with_the_one_that_does(
    shelf: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(shelf)
    before = sorted(shelf.rglob("*"))
    for name, words in WORDS.items():
        if name in READ[command]:
            continue
        message = _refused(command, name)
        assert message.startswith(f"{name}: ")
        assert words in message or re.search("(holds|has) no", message)  # of a folder, where one is read
        assert len(message) < SHORT
        assert "\n" not in message
        if words not in {"no such", "is empty", "is no file", "is a folder"}:
            assert "cosim" in message or "a browser" in message, message
    assert sorted(shelf.rglob("*")) == before


def test_every_kind_that_is_declared_is_tried() -> None:
    folders_alone = {"an input of `cosim excite`"}
    tried = {words.removeprefix("is ") for words in WORDS.values()} | folders_alone
    assert {a.kind for a in artefacts()} <= tried


def test_a_file_is_of_one_kind_by_its_keys(shelf: Path) -> None:
    """No order of the declarations decides."""
    for path in (*shelf.glob("*.json"), *shelf.glob("*.yaml"), *shelf.glob("r*/*.json")):
        if path.stat().st_size:
            keys = frozenset(YamlFile(path).root)
            matched = sorted((a.matched_keys(keys), a.kind) for a in artefacts())
            assert matched[-1][0] > matched[-2][0], path


@pytest.mark.parametrize(
    ("keys", "kind"),
    [
        ({"model"}, MODEL),
        ({"schema_version", "model", "parameters_from"}, MODEL),
        ({"model", "parameters"}, MODEL),
        ({"model", "logs"}, STUDY),
        ({"model", "noise"}, None),  # a study that forgets its logs
    ],
)
def test_a_model_file_is_none_that_is_checked_as_a_study(keys: set[str], kind: str | None) -> None:
    assert kind_by_keys(dict.fromkeys(keys)) == kind


def test_every_command_that_takes_a_file_is_tried() -> None:
    without = {"bench", "consistency", "gc", "list", "open", "schema"}
    commands = {c.name or c.callback.__name__.replace("_", "-") for c in app.registered_commands if c.callback}
    assert {text.split()[0] for text in READ} == commands - without


def test_a_command_in_a_cure_can_be_pasted_whatever_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mein Prüfstand's.csv").write_text("time,x\n0,0\n")
    assert """`cosim check 'mein Prüfstand'"'"'s.csv'`""" in _refused("run", "mein Prüfstand's.csv")


def test_a_folder_says_which_of_its_files_may_be_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("f").mkdir()
    _archive(Path("f/a.fmu"), "modelDescription.xml")
    Path("f/case.yaml").touch()
    assert _refused("info", "f") == "f: is a folder, not an FMU; in it: a.fmu"
    assert _refused("run", "f").endswith("in it: case.yaml")


@pytest.mark.parametrize("text", ["time\tx\n0\t1\n", '"time [s]" x\n0 1\n', "t; x\n0;1\n"])
def test_a_log_of_another_ending_is_no_text(tmp_path: Path, text: str) -> None:
    (tmp_path / "log.txt").write_text(text)
    assert kind_of(tmp_path / "log.txt") is None


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"# a comment\nname: s\nduration: 1\ncomponents: {}\n", SCENARIO),
        (b'{"name": "s", "components": {}}', SCENARIO),
        (b"Device: X\ntime,x\n0,1\n", LOG),
        (b"time: s,x\n0,1\n", LOG),
        ("zeit,größe\n0,1\n".encode("latin-1"), LOG),
        ("time,x\n0,1\n".encode("utf-16"), LOG),
        (b"time,x\n0,1\n" + bytes(200), LOG),  # a logger that lost its power
        (bytes((k * k + 7 * k) % 251 for k in range(900)), BINARY),
        (np.linspace(0, 1, 200).tobytes(), BINARY),
    ],
)
def test_a_csv_is_what_it_holds(tmp_path: Path, content: bytes, kind: str) -> None:
    (tmp_path / "x.csv").write_bytes(content)
    assert kind_of(tmp_path / "x.csv") == kind


def test_rows_are_those_of_a_run_where_its_manifest_lies_beside_them(shelf: Path) -> None:
    assert kind_of(shelf / "ran" / "results.csv") == RESULTS
    assert kind_of(shelf / "replayed" / "results.csv") == LOG


@pytest.mark.parametrize(
    ("component", "words"),
    [
        ("{block: reference, step: 0.2, signals: {x: {}}}", 'unknown key "step": fmu takes it, reference does not'),
        ("{block: playback, file: log.csv, rate: 2}", 'unknown key "rate": fix takes it, playback does not'),
        ("{block: reference, signals: {x: {stat: 1}}}", 'did you mean "start"? (known here: unit, start, changes)'),
        ("{fmu: x.fmu, stepp: 1}", 'did you mean "step"? (known here: fmu, process, start'),
    ],
)
def test_a_key_of_another_kind_of_component_is_told_with_what_takes_it(
    shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, component: str, words: str
) -> None:
    monkeypatch.chdir(shelf)
    (tmp_path / "s.yaml").write_text(f"name: s\nduration: 1\nstep: 0.1\ncomponents: {{a: {component}}}\n")
    done = CliRunner().invoke(app, ["run", "--in-process", str(tmp_path / "s.yaml")])
    assert words in str(done.exception)


@pytest.mark.parametrize("name", ["a" * 300 + ".yaml", "loop/x.yaml"])
def test_a_name_that_no_file_may_have_is_told_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    for command in ("run", "info", "refine", "replay", "build --model", "excite", "linearize", "compare log.csv"):
        monkeypatch.setattr("sys.argv", ["cosim", *command.split(), name])
        with pytest.raises(SystemExit) as ended:
            entry()
        assert ended.value.code == 2
        assert re.search(r"no such|too long|Too many", capsys.readouterr().err)
