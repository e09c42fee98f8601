"""Results folders of commands: default names, owners and earlier runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.base.drafts import draft_of, remove_drafts
from cosim.base.errors import Fault, InputError
from cosim.base.scratch import is_own
from cosim.storage.artefact import artefacts
from cosim.storage.files import uninterrupted, write_text
from cosim.storage.folder_lock import take_folder
from cosim.storage.table_source import suffixes

RESULTS = Path("results")
EARLIER = "runs"  # folder of earlier runs inside a results folder, 0001 and so on
MOVING, LIST = ".moving", ".files"  # inside EARLIER: a run being moved, and the list of its files
UPWARDS = re.compile(r"^([\w ]+: \"?)(?=\.\./)", re.MULTILINE)  # a YAML key whose value is a relative path upwards
REPLAY = "replay.json"  # stored with the rows of a replay
MOST_BYTES = 200_000_000  # size of a JSON or YAML file [bytes]
MOST_LISTED, LONGEST_NAME = 10_000_000, 255  # size of the list of a move [bytes], length of a name
CURE = "give another folder as --out, or write over it by --force"


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
    file, own, name = model.rpartition(":") if ".py:" in model else (model, "", "")
    path = Path(file)
    if own and name:
        return name
    if path.is_dir() or path.name in {"refine.json", "model.yaml"}:
        inner = path if path.is_dir() else path.parent
        return inner.resolve().name or "model"
    return path.stem


def manifest_in(folder: Path) -> dict[str, Any]:
    """Return the manifest in a folder, empty if unreadable."""
    return content_of(folder / "manifest.json")


def content_of(path: Path) -> dict[str, Any]:
    """Return a JSON mapping from a regular file, empty if unreadable."""
    try:
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            return {}
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def left_by_replay(folder: Path) -> dict[str, Any]:
    """Return a replay's description of its rows.

    Keys are `log`, `fmu`, `units` and `sentence`; the result is empty if unreadable.
    """
    return content_of(folder / REPLAY)


def check_ours(
    folder: Path, name: str = "", *, ssp: Path | None = None, force: bool = False, keep: bool = False
) -> None:
    """Lock a folder; raise InputError if another scenario, SSP or command owns it."""
    prepare_folder(folder, keep=keep)
    if force or not folder.is_dir():
        return
    manifest = manifest_in(folder)
    scenario, packed = manifest.get("scenario"), manifest.get("ssp")
    left = scenario.get("name") if isinstance(scenario, dict) else None
    if ssp is not None and isinstance(packed, dict) and packed.get("path") == str(ssp.resolve()):
        return
    if left is not None and (ssp is not None or left != name):
        raise InputError([Fault(folder, 0, 0, f'holds the run of another scenario, "{left}"; {CURE}')])
    check_left(folder, "cosim run")


def check_left(folder: Path, by: str, *sources: str, force: bool = False, keep: bool = False) -> None:
    """Lock a folder for a command.

    Args:
        keep: Whether files of an earlier run will move to `runs` in the folder.

    Raises:
        InputError: The folder belongs to another command, or to other sources.
    """
    prepare_folder(folder, keep=keep)
    if force or not folder.is_dir():
        return
    for left in sorted(artefacts(), key=lambda a: a.verb == by):  # other commands first
        if not left.verb or not left.is_left_in(folder):
            continue
        if left.verb != by:
            raise InputError([Fault(folder, 0, 0, f"holds what `{left.verb}` left; {CURE}")])
        content = content_of(folder / left.marks[0])
        before = [str(content.get(key) or "") for key in left.sources]
        if sources and any(before) and not all(map(_same, before, sources)):
            of = " and ".join(filter(None, before))
            raise InputError([Fault(folder, 0, 0, f"holds what `{by}` left of {of}; {CURE}")])


def _same(one: str, other: str) -> bool:
    """Return whether two names mean the same file or model."""
    try:
        return one == other or Path(one).resolve() == Path(other).resolve()
    except (OSError, ValueError):
        return False


# -- earlier runs -------------------------------------------------------------------------------------


def prepare_folder(folder: Path, *, keep: bool) -> None:
    """Lock a folder and finish an interrupted move.

    Raises:
        InputError: `keep` is impossible, or a link would lead files out of the folder.
    """
    refuse_links(folder)
    take_folder(folder)
    _finish_move(folder)
    earlier = folder / EARLIER
    if not keep or not os.path.lexists(earlier):
        return  # The new folder only needs write access to its parent.
    cure = "move it away, or give another folder as --out"
    if not earlier.is_dir():
        raise InputError([Fault(earlier, 0, 0, f"is a file; earlier runs are kept in a folder of this name; {cure}")])
    if not os.access(earlier, os.W_OK | os.X_OK) or earlier.stat().st_dev != folder.stat().st_dev:
        why = "cannot be written, or is on another disk; earlier runs are kept there"
        raise InputError([Fault(earlier, 0, 0, f"{why}; {cure}")])


def refuse_links(folder: Path) -> None:
    """Raise InputError for links in place of the folders in a results folder, and for a stranger's link to it."""
    inner = {EARLIER, *(name.partition("/")[0] for a in artefacts() for name in a.files if "/" in name)}
    why = "is a link, so files would be moved or written elsewhere; remove it, or give another folder as --out"
    faults = [Fault(folder / name, 0, 0, why) for name in sorted(inner) if (folder / name).is_symlink()]
    if folder.is_symlink() and hasattr(os, "geteuid") and folder.lstat().st_uid not in (os.geteuid(), 0):
        faults.append(Fault(folder, 0, 0, "is a link of another user; give another folder as --out"))
    if faults:
        raise InputError(faults)


def keep_earlier(folder: Path, verb: str, also: Iterable[str] = ()) -> Path | None:
    """Move an earlier run's files to the next of runs/0001, 0002.

    The files are those declared by the verb, `also`, and those of verbs whose marks are in the folder; user files stay.
    The next verb to lock the folder finishes an interrupted move.

    Returns:
        The new folder; None without files to move.
    """
    paths = _files_of(folder, verb, also)
    if not paths:
        return None
    moving = folder / EARLIER / MOVING
    with uninterrupted():
        moving.mkdir(0o700, parents=True, exist_ok=True)
        write_text(moving / LIST, "\n".join(path.relative_to(folder).as_posix() for path in paths))
        return _finish_move(folder)


def _files_of(folder: Path, verb: str, also: Iterable[str]) -> list[Path]:
    """Return the files of an earlier run in a folder."""
    declared = [a for a in artefacts() if a.verb and (a.verb == verb or a.is_left_in(folder))]
    tables = (f"{stem}{suffix}" for a in declared for stem in a.tables for suffix in suffixes())
    patterns = dict.fromkeys((*(name for a in declared for name in a.files), *tables, *also))
    return list(dict.fromkeys(p for pattern in patterns for p in sorted(folder.glob(pattern)) if p.is_file()))


def _finish_move(folder: Path) -> Path | None:
    """Finish a move listed in `runs`; return its folder.

    Raises:
        InputError: Another user can have written the list, or the list names files outside the folder.
    """
    moving = folder / EARLIER / MOVING
    if not os.path.lexists(moving):
        return None
    if not is_own(moving, stat.S_ISDIR) or (os.name == "posix" and moving.stat().st_mode & 0o022):
        raise InputError([Fault(moving, 0, 0, "is open to other users, or not yours; move it away")])
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
    numbers = (int(path.name) for path in moving.parent.iterdir() if path.name.isdecimal())
    place = moving.parent / f"{max(numbers, default=0) + 1:04d}"
    moving.rename(place)
    place.chmod(stat.S_IMODE(place.parent.stat().st_mode))
    return place


def _is_inside(folder: Path, name: str) -> bool:
    """Return whether a relative path leads to a visible file in a folder, through no link and not into earlier runs."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or path.parts[0] == EARLIER:
        return False
    if any(part.startswith(".") or len(part) > LONGEST_NAME for part in path.parts):
        return False
    return not any((folder / parent).is_symlink() for parent in path.parents if parent.parts)


def _listed_names(folder: Path, moving: Path) -> list[str]:
    """Return the names in the list of an interrupted move.

    Raises:
        InputError: The list is damaged, or a name leads outside the folder or through a link.
    """
    path, cure = moving / LIST, f"move {moving} away"
    try:
        with path.open("rb") as stream:
            names = stream.read(MOST_LISTED).decode("utf-8").splitlines()
    except (OSError, ValueError):
        raise InputError([Fault(path, 0, 0, f"is damaged; {cure}")]) from None
    if outside := [name for name in names if not _is_inside(folder, name)]:
        raise InputError([Fault(path, 0, 0, f"names {outside[0][:80]}, outside {folder} or no result; {cure}")])
    folders = dict.fromkeys(moving / parent for name in names for parent in PurePosixPath(name).parents[:-1])
    if links := [place for place in folders if place.is_symlink()]:
        raise InputError([Fault(links[0], 0, 0, f"is a link, and earlier runs hold none; {cure}")])
    return names


def _move(path: Path, place: Path) -> None:
    """Move a file and adapt upward paths in YAML files. A file that has already been moved is skipped."""
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
