"""Results that somebody sent: no command hangs, breaks off with a traceback or writes control characters."""

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
from cosim.master.checkpoint import FORMAT
from tests.warm import cosim

TIMES = [k / 10 for k in range(11)]
ROWS = "time,a.x [m]\n" + "".join(f"{t},{t + 0.5}\n" for t in TIMES)
SCENARIO = {"name": "n", "components": {"a": {"block": "reference"}}, "duration": 1.0, "step": 0.1}
MANIFEST: dict[str, Any] = {
    "schema_version": 1,
    "status": "ok",
    "rows": 11,
    "scenario": SCENARIO,
    "units": {"a.x": "m"},
}
STEERING = "\x1b]0;title\x07\x1b[31m\r\x08\x9b2J\u202e\u2066"
STEERS = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
HUGE, TERABYTE = 10**400, 10**12
CRITERION = {"kind": "rms", "of": "a.x", "met": True, "value": 1.0, "max": 2.0}
Make = Callable[[Path], None]

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no named pipes")


def _pipe(name: str) -> Make:
    def make(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        if name.startswith("results."):
            (folder / "results.csv").unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return make


def _sparse(name: str, head: bytes = b"") -> Make:
    def make(folder: Path) -> None:
        if name.startswith("results."):
            (folder / "results.csv").unlink()
        with (folder / name).open("wb") as stream:
            stream.write(head)
            stream.truncate(TERABYTE)

    return make


def _record(**changes: Any) -> Make:
    return lambda folder: (folder / "manifest.json").write_text(json.dumps({**MANIFEST, **changes})) and None


def _rows(text: str) -> Make:
    return lambda folder: (folder / "results.csv").write_text(text) and None


def _link(name: str) -> Make:
    def make(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).symlink_to("/dev/zero")

    return make


def _hdf5(fill: Callable[[Any, Path], Any]) -> Make:
    """Rows in HDF5, of which `fill` writes one."""

    def make(folder: Path) -> None:
        h5py = pytest.importorskip("h5py")
        (folder / "results.csv").unlink()
        with h5py.File(folder / "results.h5", "w") as file:
            file["time"] = TIMES
            fill(file, folder)

    return make


def _external(file: Any, folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    file.create_dataset("a/x", (11,), "f8", external=[(str(folder / "pipe"), 0, 88)])


KINDS: dict[str, Make] = {
    "HDF5 with values in a pipe": _hdf5(_external),
    "HDF5 with values that are not there": _hdf5(lambda f, _: f.create_dataset("a/x", (10**12,), "f8", chunks=(1000,))),
    "pipe of rows": _pipe("results.csv"),
    "pipe of HDF5": _pipe("results.h5"),
    "pipe of a record": _pipe("manifest.json"),
    "pipe of a page": _pipe("report.html"),
    "device of rows": _link("results.csv"),
    "device of a record": _link("manifest.json"),
    "holes in MAT": _sparse("results.mat"),
    "holes in CSV": _sparse("results.csv", ROWS.encode()),
    "holes in HDF5": _sparse("results.h5", b"\x89HDF\r\n\x1a\n"),
    "holes in a record": _sparse("manifest.json"),
    "steering header": _rows(ROWS.replace("a.x", f"a.x{STEERING.replace(chr(13), '')}")),
    "steering record": _record(status=STEERING, cosim_version=STEERING, units={"a.x": STEERING}),
    "steering criterion": _record(criteria=[{**CRITERION, "of": STEERING}], scenario={**SCENARIO, "name": STEERING}),
    "half a character": _record(status="\ud800", units={"a.x": "\ud800"}, scenario={**SCENARIO, "name": "\udfff"}),
    "huge duration": _record(scenario={**SCENARIO, "duration": HUGE}),
    "huge criterion": _record(criteria=[{**CRITERION, "value": HUGE}]),
    "endless digits": lambda f: (f / "manifest.json").write_text(f'{{"rows": 1{"0" * 5000}, "status": "ok"}}') and None,
    "text for a number": _record(criteria=[{**CRITERION, "value": "big", "max": []}], timings={"simulate": "x"}),
    "lists for mappings": _record(scenario=[1], units=[2], fmus=3, git=4, versions=5, criteria={"a": 1}, ssp=6),
    "nested wrongly": _record(scenario={**SCENARIO, "components": {"a": 5}}, fmus={"a": 7}, items={"a": 4}),
    "deep record": lambda f: (f / "manifest.json").write_text('{"a":' * 99_999 + "1" + "}" * 99_999) and None,
}
VERBS = {
    "report": ["report", "{folder}"],
    "compare": ["compare", "{folder}", "results/sound", "--out", "{out}"],
    "view": ["view", "{folder}", "--prepare"],
}


@pytest.fixture(scope="module")
def sent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The current folder of results of every kind, and sound ones; one name has control characters and line feeds."""
    place = tmp_path_factory.mktemp("sent")
    for name, make in {**KINDS, "sound": None, f"tank{STEERING}\nforged line": None}.items():
        folder = place / "results" / name
        folder.mkdir(parents=True)
        (folder / "results.csv").write_text(ROWS)
        (folder / "manifest.json").write_text(json.dumps(MANIFEST))
        if make is not None:
            make(folder)
    return place


def _run(place: Path, *words: str) -> Any:
    done = cosim(*words, cwd=place, timeout=60.0)  # a command that hangs is killed
    assert done.returncode in {0, 2, 3, 4}
    for text in (done.stdout, done.stderr):
        assert "Traceback" not in text
        assert not STEERS.search(text)
    return done


@pytest.mark.parametrize("verb", list(VERBS))
@pytest.mark.parametrize("kind", list(KINDS))
def test_a_command_on_results_of_a_stranger_ends_without_harm(sent: Path, tmp_path: Path, kind: str, verb: str) -> None:
    words = {"folder": f"results/{kind}", "out": str(tmp_path)}
    _run(sent, *(word.format(**words) for word in VERBS[verb]))
    for page in (*tmp_path.glob("*.html"), sent / "results" / kind / "report.html"):
        if page.is_file():
            assert not STEERS.search(page.read_text())
            data = re.search(r'id="run-data">(.*?)</script>', page.read_text())
            assert data is None or not STEERS.search("".join(_texts(json.loads(data[1]))))
            if verb == "report":
                page.unlink()


def _texts(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [text for pair in value.items() for each in pair for text in _texts(each)]
    return [text for each in value for text in _texts(each)] if isinstance(value, list) else [str(value)]


@pytest.mark.parametrize("words", [["list"], ["list", "--json"], ["gc"], ["view", "--prepare"], ["open", "sound"]])
def test_a_command_on_all_results_of_a_stranger_ends_without_harm(sent: Path, words: list[str]) -> None:
    done = _run(sent, *words)
    if words[0] == "list":
        names = {*KINDS, "sound"}
        assert all(name in done.stdout for name in names)
    if words == ["list", "--json"]:
        assert f"tank{STEERING}\nforged line" in {row["name"] for row in json.loads(done.stdout)["results"]}
    elif words == ["list"]:
        assert len(done.stdout.splitlines()) == len(KINDS) + 3


def test_layouts_in_a_pipe_are_refused(sent: Path) -> None:
    os.mkfifo(sent / "pipe.json")
    assert _run(sent, "view", "sound", "--prepare", "--layout", "pipe.json").returncode == 2


STATE: dict[str, Any] = {
    "format": FORMAT, "point": 3, "time": 0.3, "rows": "", "components": {}, "links": {}, "changes": [], "elapsed": 1.0,
}  # fmt: skip


@pytest.mark.parametrize(
    "state",
    [
        [],
        {},
        {**STATE, "point": "third"},
        {**STATE, "point": 10**30},
        {**STATE, "components": {"a": 5}, "links": []},
        {**STATE, "changes": [7]},
    ],
)
def test_a_checkpoint_with_wrong_types_is_refused(tmp_path: Path, state: Any) -> None:
    made = _stopped(tmp_path)
    (made / "checkpoint" / "state").write_bytes(pack(state))
    assert _run(tmp_path, "run", "--resume", "out").returncode == 2


@pytest.mark.parametrize(
    "change",
    [
        {"scenario": {"components": 3}},
        {"files": {"rows": 4}},
        {"warnings": [5]},
        {"scenario": {**SCENARIO, "duration": HUGE}},
    ],
)
def test_a_record_of_a_stopped_run_with_wrong_types_is_refused(tmp_path: Path, change: Any) -> None:
    file = _stopped(tmp_path) / "checkpoint" / "run.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    assert _run(tmp_path, "run", "--resume", "out").returncode == 2


def _stopped(place: Path) -> Path:
    """Return the folder of a run that was stopped."""
    folder = place / "out"
    (folder / "checkpoint").mkdir(parents=True)
    record = {**MANIFEST, "cosim_version": __version__, "files": {"rows": "results.csv", "codes": [], "warnings": []}}
    (folder / "checkpoint" / "run.json").write_text(json.dumps(record))
    (folder / "checkpoint" / "state").write_bytes(pack(STATE))
    return folder
