"""Folders of results: every run is written once, to results/NAME/0001, 0002 and so on, or to a folder of the user.

While a command writes into a folder, the folder has a file STARTED that names the process. `kill -9` leaves this file,
so that `cosim list` shows the folder as interrupted.
"""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import NoneType
from typing import Any

from cosim.core.errors import InputError
from cosim.core.messages import Note
from cosim.core.scratch import temporary_folder
from cosim.core.version import __version__
from cosim.files.artefact import artefacts
from cosim.files.files import FilePath, check_writable, delay_stops, named_path, open_regular, parse_json

RESULTS_FOLDER = Path("results")
# default output folder: a new number in results/NAME, with a name chosen by the workflow
NUMBERED = RESULTS_FOLDER / "NAME"
RUN_NUMBER = re.compile(r"\d{4,15}")  # name of the folder of a run
STARTED = "started.json"
COMMAND_KEY, STATUS_KEY = "command", "status"  # keys of each record
RUNNING, INTERRUPTED = "running", "interrupted"
ELSEWHERE = "running or interrupted"  # the process is on another machine and cannot be checked
REPLAY = "replay.json"  # record of a replay, stored beside its rows
SAME_BEGINNING = 5.0  # [s] tolerance of a process's start time, since the system's clock may have been corrected
SCHEMA_VERSION = 1  # of manifest.json, replay.json and sweep.json
MAX_RECORD_BYTES = 200_000_000  # size of a JSON or YAML file [bytes]


# -- names ----------------------------------------------------------------------------------------


def name_of_file(path: Path, of: str = "") -> str:
    """Return the NAME in results/NAME for results of a file.

    A file with a general name, e.g. results.csv, is named after its folder, or after the series of runs it belongs to.
    """
    if path.stem in {"results", "refine"} and path.resolve().parent.name:
        return f"{run_name(path.resolve().parent).split('/')[0]}-{of or 'replayed'}"
    return f"{path.stem}-{of}" if of else path.stem


def name_of(model: str) -> str:
    """Return a short name of a model.

    Args:
        model: `base`, a file, file.py:Class, a refine's folder or refine.json.
    """
    file, _, name = model.rpartition(":") if ".py:" in model else (model, "", "")
    if name:
        return name
    path = Path(file)
    if not path.is_dir() and path.name not in {"refine.json", "model.yaml"}:
        return path.stem
    return run_name(path if path.is_dir() else path.parent).split("/")[0] or "model"


# -- writing --------------------------------------------------------------------------------------


@contextmanager
def new_run(out: FilePath | None, name: str, verb: str, *, force: bool = False) -> Iterator[Path]:
    """Yield the folder that a command writes into: a new number in results/NAME, or `out`.

    A folder that is empty at the end is removed. If a command calls another one with the same folder, the inner call
    only yields the folder.

    Args:
        verb: Command in messages, such as `cosim run`.
        force: Accept an `out` that is not empty.

    Raises:
        InputError: `out` is not empty, cannot be written, or another command writes into it.
    """
    with delay_stops():
        folder = _new_number(runs_named(name)) if out is None else named_path(out)
        import psutil

        is_running = state_of(folder) == RUNNING
        is_inner = is_running and content_of(folder / STARTED)["pid"] == os.getpid()
        if not is_inner:
            new = [path for path in (folder, *folder.parents) if not path.is_dir()]
            if is_running:
                raise InputError.at(folder, "another command is writing into this folder; give another --out")
            check_writable(folder, ())
            if not force and any(not path.name.startswith(".") for path in folder.iterdir()):
                raise InputError.at(folder, "is not empty; give another folder as --out, or add --force")
            (folder / STARTED).unlink(missing_ok=True)  # mark of an interrupted command
            about = {"pid": os.getpid(), "begun": psutil.Process().create_time(), "host": platform.node()}
            about |= {"schema_version": SCHEMA_VERSION, "cosim_version": __version__}
            about |= {COMMAND_KEY: verb, STATUS_KEY: INTERRUPTED}
            try:
                with (folder / STARTED).open("x", encoding="utf-8") as stream:
                    json.dump(about, stream)
            except FileExistsError:
                raise InputError.at(folder, "another command is writing into this folder") from None
            new += [folder, *folder.parents][:3] if out is None else []
    try:
        yield folder
    finally:
        if not is_inner:
            with delay_stops(), suppress(OSError):
                (folder / STARTED).unlink(missing_ok=True)
                for path in dict.fromkeys(new):
                    path.rmdir()


def runs_named(name: str) -> Path:
    """Return results/NAME with characters that are safe in shells."""
    safe = re.sub(r"\s+", "-", re.sub(r"[^\w.\-\s]+", "_", name).strip(" .")) or "run"
    return RESULTS_FOLDER / safe[:100]


def _new_number(runs: Path) -> Path:
    """Create and return the folder 0001 or the next free number, safely beside parallel commands."""
    for attempts_left in reversed(range(1000)):
        try:
            runs.mkdir(parents=True, exist_ok=True)
            numbers = [int(path.name) for path in runs.iterdir() if RUN_NUMBER.fullmatch(path.name)]
            (folder := runs / f"{max(numbers, default=0) + 1:04d}").mkdir()
            return folder
        except OSError as error:
            # A parallel command created this number first, or has just removed its empty folder.
            if not (attempts_left and isinstance(error, (FileExistsError, FileNotFoundError))):
                raise InputError.at(runs, f"cannot be the folder for results: {error.strerror}") from None
    raise AssertionError


def remove_earlier(folder: Path, *, read: Iterable[Path] = ()) -> None:
    """Remove earlier results of cosim from a folder before writing again; files of the user stay.

    Removed are the declared files of each verb whose identifying files are in the folder.

    Args:
        read: Input files, and folders of them, which stay.
    """
    from cosim.files.table import suffixes  # imports numpy, which `cosim list` does not need

    inputs = {path.resolve() for path in read}
    for artefact in artefacts():
        if not artefact.verb or not artefact.is_left_in(folder, unfinished=True):
            continue
        tables = [f"{stem}{suffix}" for stem in artefact.tables for suffix in suffixes()]
        for pattern in (*artefact.marks, *artefact.unfinished, *artefact.files, *tables):
            for path in [*folder.glob(pattern)]:
                if path.is_file() and inputs.isdisjoint((path.resolve(), path.parent.resolve())):
                    path.unlink()


# -- state ----------------------------------------------------------------------------------------


def state_of(folder: Path) -> str:
    """Return RUNNING, INTERRUPTED or ELSEWHERE for a folder whose command has not finished, else ""."""
    if not (folder / STARTED).is_file():
        return ""
    content = content_of(folder / STARTED)
    if content.get("host", platform.node()) != platform.node():
        return ELSEWHERE
    import psutil  # imported only for a folder with STARTED, because of its size

    try:  # Another process with the same id has another start time.
        begun = psutil.Process(content["pid"]).create_time()
        return RUNNING if abs(begun - content["begun"]) < SAME_BEGINNING else INTERRUPTED
    except (psutil.Error, LookupError, TypeError, ValueError, OverflowError):
        return INTERRUPTED


# -- reading --------------------------------------------------------------------------------------


def newest_run(folder: Path) -> Path:
    """Return the newest of the numbered runs in a folder, or the folder itself if it has no numbered runs."""
    try:
        numbers = [path for path in folder.iterdir() if RUN_NUMBER.fullmatch(path.name) and path.is_dir()]
    except OSError:
        return folder
    return max(numbers, key=lambda path: int(path.name), default=folder)


def run_name(folder: Path) -> str:
    """Return the name of the folder of a run; a numbered run has the form `tank/0001`."""
    *_, before, name = ("", *folder.resolve().parts)
    return f"{before}/{name}" if RUN_NUMBER.fullmatch(name) else name


def has_results(folder: Path) -> bool:
    """Return True if a folder has the results of a command or a file with rows."""
    if any(a.is_left_in(folder, unfinished=True) for a in artefacts() if a.verb) or (folder / STARTED).is_file():
        return True
    return any(folder.glob("results.*"))


def manifest_in(folder: Path) -> dict[str, Any]:
    """Return the manifest in a folder without entries of a wrong type; empty if there is none."""
    return sound_part(folder / "manifest.json", content_of(folder / "manifest.json"))[0]


def warnings_on(folder: Path) -> tuple[str, ...]:
    """Return warnings and notes about the manifest or other record in a folder."""
    file = next((path for name in ("manifest.json", REPLAY) if (path := folder / name).is_file()), None)
    if file is None:
        return ()
    if not (content := content_of(file)):
        return (f"{file} is damaged: units, texts, inputs and criteria of the run are missing; run it again",)
    record, wrong = sound_part(file, content)
    return (*other_version(file, record), *wrong)


def other_version(file: Path, record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a warning or note if another version of cosim wrote a record."""
    schema, by = record.get("schema_version", SCHEMA_VERSION), str(record.get("cosim_version", ""))
    if schema != SCHEMA_VERSION:
        known = f"this cosim reads schema version {SCHEMA_VERSION}, and ignores new or changed keys"
        cure = f"; to read them, use cosim {by}" if by else ""
        return (f"{file} has schema version {schema}, and {known}{cure}",)
    return () if by in {"", __version__} else (Note(f"{file} was written by cosim {by}, and this is {__version__}"),)


def content_of(path: Path) -> dict[str, Any]:
    """Return the mapping in a JSON file.

    The result is empty if the file is unreadable or has a number beyond the range of doubles.
    """
    try:
        stream = open_regular(path)  # faster than `open`, which matters for `cosim list`
        try:
            size = os.fstat(stream).st_size
            content = parse_json(os.read(stream, size) if size <= MAX_RECORD_BYTES else b"")
        finally:
            os.close(stream)
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def status_in(folder: Path) -> str:
    """Return the status of an incomplete command as a phrase, else ""."""
    status = (manifest_in(folder) or replay_record(folder) or content_of(folder / STARTED)).get(STATUS_KEY, "ok")
    return "" if status == "ok" else f" (status: {state_of(folder) or status})"


def replay_record(folder: Path) -> dict[str, Any]:
    """Return the record of a replay, which is stored beside its rows.

    Keys are `log`, `fmu`, `units` and `sentence`. Values of wrong types are left out.
    """
    return sound_part(folder / REPLAY, content_of(folder / REPLAY))[0]


@contextmanager
def results_in(out: FilePath | None, verb: str, name: str, *, force: bool = False) -> Iterator[Path]:
    """Yield the output folder: `out`, which must be empty unless `force`, or a temporary folder if `out` is None.

    NUMBERED as `out` means a new number in results/NAME.
    """
    with (
        temporary_folder("run") if out is None else nullcontext(None if out is NUMBERED else out) as place,
        new_run(place, name, verb, force=force) as folder,
    ):
        yield folder


# -- types of the values in records ---------------------------------------------------------------

EACH = "*"  # key of a type of mappings, for all their values
NUMBER_TYPES = (int, float, NoneType)
# A type is a class or several, a list with the type of each element, or a mapping from keys, which may be absent
CRITERION = {"kind": str, "of": str, "met": bool, "value": NUMBER_TYPES, "max": NUMBER_TYPES}
COMMON_KEY_TYPES: Mapping[str, Any] = {
    **dict.fromkeys(("cosim_version", "version", "command", "status", "verdict", "sentence"), str),
    "schema_version": int,
}
FILE_KEY_TYPES: Mapping[str, Mapping[str, Any]] = {
    "manifest.json": {
        **dict.fromkeys(("source", "loop", "no_report"), str),
        **{key: [str] for key in ("set", "order", "held", "beside", "discrete", "texts", "warnings")},
        **dict.fromkeys(("versions", "timings", "steps", "pacing"), dict),
        **{key: {EACH: dict} for key in ("items", "validity", "event_counts")},
        "git": (dict, NoneType),
        "loops": [dict],
        "scenario": {"name": str, "components": {EACH: dict}, "connections": [dict], "faults": [dict]},
        "rows": int,
        "criteria": [CRITERION],
        "units": {EACH: str},
        "display": {EACH: list},
        "unit_definitions": {EACH: [NUMBER_TYPES]},
        "fmus": {EACH: dict},
    },
    "replay.json": {"log": str, "fmu": str, "units": {EACH: str}, "display": {EACH: list}, "start": dict},
    "sweep.json": {"runs": int, "failed": int, "criteria": [dict]},
    "comparison.json": {"signals": [dict], "criteria": [dict]},
}


def has_type(value: Any, kind: Any) -> bool:
    """Return True if a value and all its elements have the declared types. Booleans are not integers."""
    if isinstance(kind, list):
        return type(value) is list and all(has_type(each, kind[0]) for each in value)
    if isinstance(kind, dict):
        wanted = ((each, kind.get(EACH, kind.get(key))) for key, each in value.items()) if type(value) is dict else ()
        return type(value) is dict and all(each_kind is None or has_type(each, each_kind) for each, each_kind in wanted)
    return type(value) in (kind if isinstance(kind, tuple) else (kind,))


def sound_part(file: Path, record: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a record without the keys whose values have a wrong type, and a warning for each."""
    kinds = {**COMMON_KEY_TYPES, **FILE_KEY_TYPES.get(file.name, {})}
    wrong = [key for key, kind in kinds.items() if key in record and not has_type(record[key], kind)]
    cure = "has a value of a wrong type and is not used: run it again, or correct the file"
    return {k: v for k, v in record.items() if k not in wrong}, tuple(f"{file}: {key} {cure}" for key in wrong)
