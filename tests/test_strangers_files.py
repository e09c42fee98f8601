"""Results from untrusted sources: no command hangs, shows a traceback or writes control characters."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cosim.core.version import __version__
from cosim.files.state_file import pack
from tests.warm import cosim

ROWS = "time,a.x [m]\n" + "".join(f"{k / 10},{k / 10 + 0.5}\n" for k in range(11))
SCENARIO = '"scenario": {"name": "n", "components": {"a": {"block": "reference"}}, "duration": 1.0, "step": 0.1}'
MANIFEST = f'{{"schema_version": 1, "status": "ok", "rows": 11, {SCENARIO}, "units": {{"a.x": "m"}}}}'
STEERING = "\x1b]0;title\x07\x1b[31m\r\x08\x9b2J\u202e\u2066"
STEERS = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
CODED, HUGE, TERABYTE = json.dumps(STEERING), 10**400, 10**12
Make = Callable[[Path], object]  # writes a file that is not there

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no named pipes")


def _holes(head: bytes = b"") -> Make:
    def make(file: Path) -> None:
        file.write_bytes(head)
        os.truncate(file, TERABYTE)

    return make


def _hdf5(fill: Callable[[Any, Path], object]) -> Make:
    """Rows in HDF5, of which `fill` writes one."""

    def make(path: Path) -> None:
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["time"] = [k / 10 for k in range(11)]
            fill(file, path.with_name("pipe"))

    return make


def _external(file: Any, pipe: Path) -> None:
    os.mkfifo(pipe)
    file.create_dataset("a/x", (11,), "f8", external=[(str(pipe), 0, 88)])


def _zero(file: Path) -> None:
    file.symlink_to("/dev/zero")


FILES: dict[str, tuple[str, Make]] = {
    "HDF5 with values in a pipe": ("results.h5", _hdf5(_external)),
    "HDF5 with values that are not there": (
        "results.h5", _hdf5(lambda f, _: f.create_dataset("a/x", (TERABYTE,), "f8", chunks=(1000,))),
    ),
    "pipe of rows": ("results.csv", os.mkfifo),
    "pipe of HDF5": ("results.h5", os.mkfifo),
    "pipe of a record": ("manifest.json", os.mkfifo),
    "pipe of a page": ("report.html", os.mkfifo),
    "device of rows": ("results.csv", _zero),
    "device of a record": ("manifest.json", _zero),
    "holes in MAT": ("results.mat", _holes()),
    "holes in CSV": ("results.csv", _holes(ROWS.encode())),
    "holes in HDF5": ("results.h5", _holes(b"\x89HDF\r\n\x1a\n")),
    "holes in a record": ("manifest.json", _holes()),
    "steering header": (
        "results.csv", lambda f: f.write_text(ROWS.replace("a.x", f"a.x{STEERING.replace(chr(13), '')}")),
    ),
    "endless digits": ("manifest.json", lambda f: f.write_text(f'{{"rows": 1{"0" * 5000}, "status": "ok"}}')),
    "deep record": ("manifest.json", lambda f: f.write_text('{"a":' * 99_999 + "1" + "}" * 99_999)),
}  # fmt: skip
RECORDS = {  # what stands in place of keys of the record
    "steering record": f'"status": {CODED}, "cosim_version": {CODED}, "units": {{"a.x": {CODED}}}',
    "steering criterion": f'"criteria": [{{"kind": "rms", "of": {CODED}, "met": true, "value": 1, "max": 2}}]',
    "half a character": r'"status": "\ud800", "units": {"a.x": "\ud800"}, ' + SCENARIO.replace('"n"', r'"\udfff"'),
    "steering name": SCENARIO.replace('"n"', CODED),
    "huge duration": SCENARIO.replace("1.0", f"{HUGE}"),
    "huge criterion": f'"criteria": [{{"kind": "rms", "of": "a.x", "met": true, "value": {HUGE}, "max": 2}}]',
    "text for a number": '"criteria": [{"of": "a.x", "value": "big", "max": []}], "timings": {"simulate": "x"}',
    "lists for mappings": '"scenario": [1], "units": [2], "fmus": 3, "git": 4, "criteria": {"a": 1}, "versions": 5',
    "nested wrongly": '"scenario": {"name": "n", "components": {"a": 5}}, "fmus": {"a": 7}, "items": {"a": 4}',
}
KINDS = [*FILES, *RECORDS]
VERBS = ("report {0}", "compare {0} results/sound --out {1}", "view {0} --prepare")


def changed(keys: str) -> str:
    """Return the text of the record, or of one with other keys."""
    return json.dumps({**json.loads(MANIFEST), **json.loads(f"{{{keys}}}")})


@pytest.fixture(scope="module")
def sent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The current folder of results of every kind, and sound ones; one name has control characters and line feeds."""
    place = tmp_path_factory.mktemp("sent")
    for name in (*KINDS, "sound", f"tank{STEERING}\nforged line"):
        folder = place / "results" / name
        folder.mkdir(parents=True)
        file, make = FILES.get(name, ("", None))
        if not file.startswith("results."):
            (folder / "results.csv").write_text(ROWS)
        if file != "manifest.json":
            (folder / "manifest.json").write_text(changed(RECORDS.get(name, "")))
        if make:
            make(folder / file)
    return place


def _run(place: Path, *words: str) -> Any:
    done = cosim(*words, cwd=place, timeout=60.0)  # a command that hangs is killed
    assert done.returncode in {0, 2, 3, 4}
    for text in (done.stdout, done.stderr):
        assert "Traceback" not in text
        assert not STEERS.search(text)
    return done


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_command_on_results_of_a_stranger_ends_without_harm(sent: Path, tmp_path: Path, kind: str, verb: str) -> None:
    _run(sent, *(word.format(f"results/{kind}", tmp_path) for word in verb.split()))
    for page in (*tmp_path.glob("*.html"), sent / "results" / kind / "report.html"):
        if page.is_file():
            assert not STEERS.search(page.read_text())
            data = re.search(r'id="run-data">(.*?)</script>', page.read_text())
            assert data is None or not STEERS.search("".join(_texts(json.loads(data[1]))))
            if verb.startswith("report"):
                page.unlink()


def _texts(value: Any) -> list[str]:
    if isinstance(value, dict):
        value = [*value, *value.values()]
    return [text for each in value for text in _texts(each)] if isinstance(value, list) else [str(value)]


@pytest.mark.parametrize(
    "words", ["list", "list --json", "gc", "view --prepare", "open sound", "view --layout pipe.json"]
)
def test_a_command_on_all_results_of_a_stranger_ends_without_harm(sent: Path, words: str) -> None:
    if "pipe" in words:
        os.mkfifo(sent / "pipe.json")
        words += " sound --prepare"
    done = _run(sent, *words.split())
    assert done.returncode == 2 or "pipe" not in words
    if words == "list":
        assert len(done.stdout.splitlines()) == len(KINDS) + 3
    elif words == "list --json":
        names = {row["name"] for row in json.loads(done.stdout)["results"]}
        assert names == {*KINDS, "sound", f"tank{STEERING}\nforged line"}


STATE: dict[str, Any] = {
    "point": 3, "time": 0.3, "rows": "", "components": {}, "links": {}, "changes": [],
}  # fmt: skip
FILES_OF_RUN = f'"cosim_version": "{__version__}", "files": {{"rows": "results.csv", "codes": [], "warnings": []}}'


@pytest.mark.parametrize(
    ("state", "record"),
    [
        ([], ""),
        ({}, ""),
        ({**STATE, "point": "third"}, ""),
        ({**STATE, "point": 10**30}, ""),
        ({**STATE, "components": {"a": 5}, "links": []}, ""),
        ({**STATE, "changes": [7]}, ""),
        (STATE, ', "scenario": {"components": 3}'),
        (STATE, ', "files": {"rows": 4}'),
        (STATE, ', "warnings": [5]'),
        (STATE, f", {RECORDS['huge duration']}"),
    ],
)
def test_a_stopped_run_with_wrong_types_is_refused(tmp_path: Path, state: Any, record: str) -> None:
    checkpoint = tmp_path / "out" / "checkpoint"
    checkpoint.mkdir(parents=True)
    (checkpoint / "run.json").write_text(changed(FILES_OF_RUN + record))
    (checkpoint / "state").write_bytes(pack(state))
    assert _run(tmp_path, "run", "--resume", "out").returncode == 2
