"""Results folders of commands: default names, owners and earlier runs."""

from __future__ import annotations

import mmap
import os
import re
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.base.drafts import draft_of, remove_drafts
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.messages import Note
from cosim.base.scratch import is_own
from cosim.base.version import __version__
from cosim.storage.artefact import Artefact, artefacts
from cosim.storage.files import delay_stops, open_regular, parse_json, write_text
from cosim.storage.folder_lock import take_folder
from cosim.storage.record_types import sound_part
from cosim.storage.started import COMMAND, KILLED, START, STARTED, STATUS, bring_killed, is_killed, write_start

RESULTS = Path("results")
EARLIER = "runs"  # folder of earlier runs inside a results folder, 0001 and so on
MOVING, LIST = ".moving", ".files"  # inside EARLIER: a run being moved, and the list of its files
LAST = ".last"  # inside EARLIER: the highest number ever given; no later run has the number of a removed one
UPWARDS = re.compile(r"^([\w ]+: \"?)(?=\.\./)", re.MULTILINE)  # a YAML key whose value is a relative path upwards
REPLAY = "replay.json"  # stored with the rows of a replay
SCHEMA_VERSION = 1  # of manifest.json, replay.json and sweep.json
MOST_BYTES = 200_000_000  # size of a JSON or YAML file [bytes]
MOST_LISTED, LONGEST_NAME = 10_000_000, 255  # size of the list of a move [bytes], length of a name
MOST_DIGITS = 15  # of the number of an earlier run


def folder_named(name: str, of: str = "") -> Path:
    """Return results/NAME or results/NAME-OF, safe for shells."""
    safe = re.sub(r"\s+", "-", re.sub(r"[^\w.\-\s]+", "_", name).strip(" .")) or "run"
    return RESULTS / (safe[: 100 - len(of)] + (f"-{of}" if of else ""))


def folder_of_file(path: Path, of: str = "") -> Path:
    """Return results/NAME for the name of a file.

    Files with a general name, e.g. results.csv, take the name of their folder.
    """
    if path.stem in {"results", "refine"} and path.resolve().parent.name:
        return folder_named(path.resolve().parent.name, of or "replayed")
    return folder_named(path.stem, of)


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
    return (path if path.is_dir() else path.parent).resolve().name or "model"


def manifest_in(folder: Path) -> dict[str, Any]:
    """Return the sound part of the manifest in a folder."""
    return sound_part(folder / "manifest.json", content_of(folder / "manifest.json"))[0]


def warnings_on(folder: Path) -> tuple[str, ...]:
    """Return warnings and notes on the record in a folder."""
    file = next((path for name in ("manifest.json", REPLAY) if (path := folder / name).is_file()), None)
    if file is None:
        return ()
    content = content_of(file)
    record, wrong = sound_part(file, content)
    return (
        (*other_version(file, record), *wrong)
        if content
        else (f"{file} is damaged: units, texts, inputs and criteria of its run are not known; run it again",)
    )


def other_version(file: Path, record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a warning or note on another version's record."""
    schema, by = record.get("schema_version", SCHEMA_VERSION), version_of(record)
    if schema != SCHEMA_VERSION:
        by = by or "of an unknown version"
        return (
            (
                f"{file} has the schema version {schema}, written by cosim {by}; {SCHEMA_VERSION} is known here: "
                "keys that are new or changed are not read, use that version of cosim"
            ),
        )
    return (
        (Note(f"{file} was written by cosim {by}, and this is {__version__}"),) if by not in {"", __version__} else ()
    )


def version_of(record: Mapping[str, Any]) -> str:
    """Return the version that wrote a record; "" if unknown."""
    version = record.get("cosim_version", record.get("version"))
    return version if isinstance(version, str) else ""


def content_of(path: Path) -> dict[str, Any]:
    """Return a file's JSON mapping, empty if unreadable or with a number that no double holds."""
    try:
        content = parse_json(_plain_bytes(path))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _plain_bytes(path: Path) -> bytes:
    """Return the bytes of a regular file, none if large."""
    stream = open_regular(path)  # faster than a file of Python, which `cosim list` notices
    try:
        size = os.fstat(stream).st_size
        return os.read(stream, size) if size <= MOST_BYTES else b""
    finally:
        os.close(stream)


def status_in(folder: Path) -> str:
    """Return an incomplete command's status as a phrase, else ""."""
    status = (manifest_in(folder) or replay_record(folder) or content_of(folder / START)).get("status", "ok")
    return "" if status == "ok" else f" (status: {status})"


def replay_record(folder: Path) -> dict[str, Any]:
    """Return a replay's description of its rows.

    Keys are `log`, `fmu`, `units` and `sentence`; values of wrong types are left out, and all if unreadable.
    """
    return sound_part(folder / REPLAY, content_of(folder / REPLAY))[0]


def record_of(rows: Path) -> dict[str, Any]:
    """Return the record of rows, empty for foreign tables."""
    return (manifest_in(rows.parent) or replay_record(rows.parent)) if rows.stem == "results" else {}


def check_run_folder(folder: Path, name: str = "", *, ssp: Path | None = None, force: bool = False) -> None:
    """Lock a folder; raise InputError for another owner."""
    prepare_folder(folder)
    if force or not folder.is_dir():
        return
    manifest = manifest_in(folder)
    scenario, archive = manifest.get("scenario"), manifest.get("ssp")
    owner = scenario.get("name") if isinstance(scenario, dict) else None
    if ssp is not None and isinstance(archive, dict) and archive.get("path") == str(ssp.resolve()):
        return
    if owner is not None and (ssp is not None or owner != name):
        raise InputError.at(
            folder,
            (
                f'holds the run of another scenario, "{owner}"; give another folder as --out, or move it to runs by '
                "--force"
            ),
        )
    check_overwritable(folder, "cosim run")


def check_overwritable(folder: Path, by: str, *sources: str, force: bool = False) -> None:
    """Lock a results folder; refuse results of another origin.

    Raises:
        InputError: The folder belongs to another command, or to other sources.
    """
    prepare_folder(folder)
    if force or not folder.is_dir():
        return
    for artefact in sorted(artefacts(), key=lambda a: a.verb == by):  # other commands first
        if not artefact.verb or not artefact.is_left_in(folder):
            continue
        if artefact.verb != by:
            raise InputError.at(
                folder,
                (
                    f"contains results of `{artefact.verb}`; give another folder with --out, or move them to runs "
                    "with --force"
                ),
            )
        content = content_of(folder / artefact.marks[0])
        earlier = [_source_text(content.get(key)) for key in artefact.sources]
        if sources and any(earlier) and not all(map(_is_same, earlier, sources)):
            names = " and ".join(filter(None, earlier))
            raise InputError.at(
                folder,
                (
                    f"contains results of `{by}` from {names}; give another folder with --out, or move them to runs "
                    "with --force"
                ),
            )


def _source_text(value: Any) -> str:
    """Return one or several sources as text."""
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value or "")


def _is_same(one: str, other: str) -> bool:
    """Return whether two names mean one file or model."""
    try:
        return one == other or Path(one).resolve() == Path(other).resolve()
    except (OSError, ValueError):
        return False


# -- earlier runs -------------------------------------------------------------------------------------


def prepare_folder(folder: Path, *, keep: bool = True) -> None:
    """Lock a results folder; finish an interrupted move.

    Args:
        keep: Whether files of an earlier run will move to `runs` in the folder.

    Raises:
        InputError: `keep` is impossible, or a link would lead files out of the folder.
    """
    refuse_links(folder)
    take_folder(folder)
    _finish_move(folder)
    earlier = folder / EARLIER
    if not keep or not os.path.lexists(earlier):
        return  # The new folder only needs write access to its parent.
    if not earlier.is_dir():
        raise InputError.at(
            earlier,
            (
                "is a file; earlier runs are kept in a folder of this name; move it away, or give another folder as "
                "--out"
            ),
        )
    if not os.access(earlier, os.W_OK | os.X_OK) or earlier.stat().st_dev != folder.stat().st_dev:
        raise InputError.at(
            earlier,
            (
                "cannot be written, or is on another disk; earlier runs are kept there; move it away, or give "
                "another folder as --out"
            ),
        )


def refuse_links(folder: Path) -> None:
    """Raise InputError for links in or to a folder."""
    inner = {EARLIER, STARTED, *(part for a in artefacts() for part in a.folders)}
    links = [folder / name for name in sorted(inner) if (folder / name).is_symlink()]
    faults = [
        Fault(
            link,
            0,
            0,
            "is a link, so files would be moved or written elsewhere; remove it, or give another folder as --out",
        )
        for link in links
    ]
    if hasattr(os, "geteuid"):
        path = folder.absolute()
        planted = [p for p in (path, *path.parents) if p.is_symlink() and p.lstat().st_uid not in (os.geteuid(), 0)]
        faults += [Fault(link, 0, 0, "is a link of another user; give another folder as --out") for link in planted]
    refuse(faults)


def keep_earlier(folder: Path, verb: str, also: Iterable[str] = (), *, read: Iterable[Path] = ()) -> Path | None:
    """Move an earlier run's files to the next of runs/0001, 0002.

    The files are those declared by the verb, `also`, and those of verbs whose marks are in the folder; user files stay.
    The next verb to lock the folder finishes an interrupted move. The record of a killed command is a run of its own.

    Args:
        read: Input files of the verb, and folders of them, which stay where they are.

    Returns:
        The new folder; None without files to move.
    """
    _bring_killed(folder, verb, also, read)
    return _keep(folder, verb, also, read)


def begin(folder: Path, verb: str, record: str, content: Mapping[str, Any], *, read: Iterable[Path] = ()) -> None:
    """Write the record by which a killed command is listed.

    Earlier results stay where they are. But if a command was killed after them, its record is now the newest.

    Args:
        record: Name of the record: manifest.json, replay.json or started.json.
        read: Input files of the verb, which stay where they are.
    """
    with suppress(OSError):
        _bring_killed(folder, verb, (), read)
    write_start(folder, record, content)


def begin_unrecorded(folder: Path, verb: str, read: Iterable[Path]) -> None:
    """Begin a command without a record before its end."""
    about = {"schema_version": SCHEMA_VERSION, "cosim_version": __version__, COMMAND: verb, STATUS: KILLED}
    begin(folder, verb, START, about, read=read)


def _bring_killed(folder: Path, verb: str, also: Iterable[str], read: Iterable[Path]) -> None:
    """Make a killed command's record the newest results."""
    if not is_killed(folder):
        return
    with delay_stops():
        if has_results(folder):
            _keep(folder, verb, also, read)
        bring_killed(folder)


def has_results(folder: Path) -> bool:
    """Return whether a folder has results or rows."""
    if any(a.is_left_in(folder, unfinished=True) for a in artefacts() if a.verb) or (folder / START).is_file():
        return True
    return any(folder.glob("results.*"))


def _keep(folder: Path, verb: str, also: Iterable[str], read: Iterable[Path]) -> Path | None:
    inputs, moving = {path.resolve() for path in read}, folder / EARLIER / MOVING
    paths = [p for p in _files_of(folder, verb, also) if inputs.isdisjoint((p.resolve(), p.parent.resolve()))]
    if not paths:
        return None
    with delay_stops():
        moving.mkdir(0o700, parents=True, exist_ok=True)
        write_text(moving / LIST, "\n".join(path.relative_to(folder).as_posix() for path in paths))
        return _finish_move(folder)


def _files_of(folder: Path, verb: str, also: Iterable[str]) -> list[Path]:
    """Return an earlier run's files in a folder."""
    declared = [a for a in artefacts() if a.verb and (a.verb == verb or a.is_left_in(folder))]
    paths = (path for artefact in declared for path in _files_by(artefact, folder))
    more = (path for pattern in also for path in sorted(folder.glob(pattern)))
    every = dict.fromkeys((*paths, *more, folder / START))
    return [p for p in every if p.is_file() and not p.name.startswith(".")]  # a lock is no result


def _files_by(artefact: Artefact, folder: Path) -> Iterator[Path]:
    """Yield the files of a verb in a folder. Without results of the verb, a folder within is the user's."""
    from cosim.storage.table import suffixes  # numpy, which `cosim list` does not need

    is_there = artefact.is_left_in(folder, unfinished=True)
    names = [*artefact.files, *(f"{stem}{suffix}" for stem in artefact.tables for suffix in suffixes())]
    for pattern in names:
        if is_there or "/" not in pattern:
            yield from sorted(folder.glob(pattern))
    times = [(folder / mark).stat().st_mtime for mark in artefact.marks if (folder / mark).is_file()]
    for path in (path for pattern in artefact.drawn for path in sorted(folder.glob(pattern))):
        if times and path.stat().st_mtime >= min(times):
            yield path


def _finish_move(folder: Path) -> Path | None:
    """Finish a move listed in `runs`; return its folder.

    Raises:
        InputError: Another user can have written the list, or the list names files outside the folder.
    """
    moving = folder / EARLIER / MOVING
    if not os.path.lexists(moving):
        return None
    if not is_own(moving, stat.S_ISDIR) or (os.name == "posix" and moving.stat().st_mode & 0o022):
        raise InputError.at(moving, "is open to other users, or not yours; move it away")
    if is_own(moving / LIST, stat.S_ISREG):
        names = _listed_names(folder, moving)
        for name in names:
            _move(folder / name, moving / name)
        remove_drafts(moving, names)
        (moving / LIST).unlink()
    remove_drafts(moving, (LIST,))
    if not any(moving.iterdir()):
        moving.rmdir()
        return None
    place = moving.parent / f"{_following(moving.parent):04d}"
    write_text(moving.parent / LAST, f"{int(place.name)}\n")
    moving.rename(place)
    place.chmod(stat.S_IMODE(place.parent.stat().st_mode))
    return place


def rows_of_killed(folder: Path, stem: str) -> Path | None:
    """Give the rows that a killed command was writing as CSV a name, without a last line that is cut.

    The caller must hold the folder's lock, as after `prepare_folder`.

    Returns:
        The file, which is among the earlier runs if the folder has such a file; None without rows.
    """
    name, found = f"{stem}.csv", None
    for draft in drafts_of_killed(folder, name):
        with draft.open("rb+") as stream, suppress(ValueError):
            size = os.fstat(stream.fileno()).st_size
            content = mmap.mmap(stream.fileno(), 0)
            end = content.rfind(b"\n") + 1
            has_rows = 0 <= content.find(b"\n") + 1 < end
            content.close()
            if end < size:
                stream.truncate(end)
            if has_rows:
                place = folder if not os.path.lexists(folder / name) else new_earlier(folder)
                found = draft.replace(place / name)
    return found


def drafts_of_killed(folder: Path, start: str) -> list[Path]:
    """Return killed commands' drafts of names with this beginning."""
    if not take_folder(folder):
        return []
    return [p for p in sorted(folder.glob(f".{start}.*")) if p.suffix[1:].isdecimal() and is_own(p, stat.S_ISREG)]


def new_earlier(folder: Path) -> Path:
    """Return a new, empty folder among earlier runs."""
    earlier = folder / EARLIER
    earlier.mkdir(exist_ok=True)
    place = earlier / f"{_following(earlier):04d}"
    write_text(earlier / LAST, f"{int(place.name)}\n")
    place.mkdir()
    return place


def _following(earlier: Path) -> int:
    """Return the number of the next earlier run."""
    return next_number(earlier, [path.name for path in earlier.iterdir()])


def next_number(earlier: Path, there: Iterable[str]) -> int:
    """Return a number that no earlier run has or had.

    Args:
        there: Names in the folder.
    """
    last = ""
    with suppress(OSError, ValueError):  # no file, as written by a version without it
        if stat.S_ISREG((earlier / LAST).lstat().st_mode):
            last = (earlier / LAST).read_text(encoding="ascii")[: MOST_DIGITS + 1].strip()
    return max((int(name) for name in (last, *there) if name.isdecimal() and len(name) <= MOST_DIGITS), default=0) + 1


def note_last_number(earlier: Path) -> None:
    """Note the highest number before runs are removed."""
    if earlier.is_dir() and not (earlier / LAST).is_file():
        write_text(earlier / LAST, f"{_following(earlier) - 1}\n")


def _is_inside(folder: Path, name: str) -> bool:
    """Return whether a relative path leads to a visible file in a folder, through no link and not into earlier runs."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or path.parts[0] == EARLIER:
        return False
    if any(part.startswith(".") or len(part) > LONGEST_NAME for part in path.parts):
        return False
    return not any((folder / parent).is_symlink() for parent in path.parents if parent.parts)


def _listed_names(folder: Path, moving: Path) -> list[str]:
    """Return the names of an interrupted move.

    Raises:
        InputError: The list is damaged, or a name leads outside the folder or through a link.
    """
    path = moving / LIST
    try:
        with path.open("rb") as stream:
            names = stream.read(MOST_LISTED).decode("utf-8").splitlines()
    except (OSError, ValueError):
        raise InputError.at(path, f"is damaged; move {moving} away") from None
    if outside := [name for name in names if not _is_inside(folder, name)]:
        raise InputError.at(path, f"names {outside[0][:80]}, outside {folder} or no result; move {moving} away")
    folders = dict.fromkeys(moving / parent for name in names for parent in PurePosixPath(name).parents[:-1])
    if links := [place for place in folders if place.is_symlink()]:
        raise InputError.at(links[0], f"is a link, and earlier runs hold none; move {moving} away")
    return names


def _move(path: Path, place: Path) -> None:
    """Move a file and adapt upward paths in YAML files; an already moved file is skipped."""
    if not path.is_file():
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".yaml" and not path.is_symlink() and path.stat().st_size <= MOST_BYTES:
        text = path.read_text(encoding="utf-8", errors="surrogateescape")
        if UPWARDS.search(text):
            with draft_of(place) as draft:
                draft.write_text(UPWARDS.sub(r"\1../../", text), encoding="utf-8", errors="surrogateescape")
                shutil.copymode(path, draft)
            path.unlink()
            return
    path.replace(place)
    with suppress(OSError):  # fails in a folder with further files
        path.parent.rmdir()
