"""Every command with every kind of file that it does not read: the message names kind and reading command, exit code
2."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from cosim.files.artefact import BINARY, LOG, RESULTS
from cosim.files.kinds import kind_of
from tests.test_first_steps import told

DESCRIBED = """<fmiModelDescription fmiVersion="2.0" modelName="x" guid="1"><CoSimulation modelIdentifier="x"/>
<ModelVariables/><ModelStructure/></fmiModelDescription>"""
SCENARIOS = {"scenario.yaml", "ran/manifest.json", "x.ssp"}
STUDIES = {"study.yaml", "fit.yaml"}  # a study says which model it names
MODELS = {"model.yaml", "model.py", "refined", "refined/refine.json"} | STUDIES
LOGS = {"log.csv", "ran/results.csv"}
FMUS = {"x.fmu", "as.zip"}
RUNS = {"ran", "replayed"}
OTHERS = {"sweep.yaml", "protocol.yaml", "model.yaml", "model.py", "log.csv", "design.yaml"}
READ = {  # command → what it reads
    "run": SCENARIOS,
    "graph": SCENARIOS,
    "export-ssp": SCENARIOS,
    "check": SCENARIOS | FMUS | STUDIES | OTHERS,
    "replay": LOGS,
    "replay log.csv --plant": FMUS,
    "fit --fmu x.fmu": LOGS,
    "fit log.csv --fmu": FMUS,
    "fit": LOGS | STUDIES,
    "refine": {"study.yaml"},
    "excite": MODELS | FMUS,
    "linearize": (MODELS | FMUS) - STUDIES,
    "build --model": MODELS,
    "identify": {"protocol.yaml"},
    "sweep": {"sweep.yaml"},
    "info": FMUS,
    "init": FMUS,
    "simulate": FMUS,
    "simulate x.fmu --input": LOGS,
    "compare log.csv": LOGS | RUNS,
    "report": {"ran"},
    "view": LOGS | RUNS,
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
        "fit.json": json.dumps({**answer, "parameters": {}, "simulations": 1, "logs": []}),
        "replay.json": json.dumps({**answer, "units": {}}),
        "view.json": json.dumps({**answer, "layouts": {}}),
        "report.html": "<!doctype html>\n<html>" + "<p>word</p>" * 300,
        "graph.svg": '<svg xmlns="http://www.w3.org/2000/svg" aria-label="' + "a, " * 300 + '"/>',
        "a.ipynb": '{"cells": [], "nbformat": 4}',
        "notes.txt": "some words, and\nmore of them\n",
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_text(text)
    heads = {
        "a.png": b"\x89PNG\r\n\x1a\n\0\0",
        "sweep.parquet": b"PAR1\0PAR1", "a.so": b"\x7fELF\2\1\t",
        "runs.sqlite": b"SQLite format 3\0",
    }  # fmt: skip
    for name, head in heads.items():
        (folder / name).write_bytes(head)
    _archive(folder / "x.fmu", "modelDescription.xml")
    _archive(folder / "as.zip", "modelDescription.xml", "a.txt")
    _archive(folder / "x.ssp", "SystemStructure.ssd")
    _archive(folder / "a.zip", "a.txt")
    os.mkfifo(folder / "pipe")
    return folder


def _refused(command: str, name: str) -> str:
    here = ["--in-process"] if command.split()[0] in {"run", "replay"} else []  # no worker has to be started
    out = ["--out", "made.yaml"] if command == "init" else []
    lines = told(*command.split(), name, *here, *out, code=2).splitlines()
    return "\n".join(line for line in lines if "no parameter to estimate" not in line)  # of x.fmu, by `cosim fit`


@pytest.mark.thorough
@pytest.mark.parametrize("command", READ)
def test_what_a_command_does_not_read_is_named_with_the_one_that_does(
    shelf: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(shelf)
    before = sorted(shelf.rglob("*"))
    names = {str(path.relative_to(shelf)) for path in before} - {"replayed/residual.csv", "replayed/results.csv"}
    for name in sorted((names | {"none.yaml"}) - READ[command]):
        message = _refused(command, name)
        assert message.startswith(f"{name}: ")
        assert len(message) < 400  # characters that are read before one gives up
        assert "\n" not in message
    assert sorted(shelf.rglob("*")) == before


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"Device: X\ntime,x\n0,1\n", LOG),
        ("zeit,größe\n0,1\n".encode("latin-1"), LOG),
        ("time,x\n0,1\n".encode("utf-16"), LOG),
        (b"time,x\n0,1\n" + bytes(200), LOG),  # a logger that lost its power
        (np.linspace(0, 1, 200).tobytes(), BINARY),
    ],
)
def test_a_csv_is_what_it_holds(tmp_path: Path, content: bytes, kind: str) -> None:
    (tmp_path / "x.csv").write_bytes(content)
    assert kind_of(tmp_path / "x.csv") == kind


def test_rows_are_those_of_a_run_where_its_manifest_lies_beside_them(shelf: Path) -> None:
    assert kind_of(shelf / "ran" / "results.csv") == RESULTS
    assert kind_of(shelf / "replayed" / "results.csv") == LOG
