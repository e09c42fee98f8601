"""The folder that a command leaves its results in: which one without --out, and whose it is already."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError
from cosim.storage.artefact import artefacts
from cosim.storage.folder_lock import take_folder

RESULTS = Path("results")
REPLAY = "replay.json"  # beside the rows of a replay
CURE = "give another folder as --out, or write over it by --force"


def folder_named(name: str, of: str = "") -> Path:
    """results/NAME, or NAME-OF, with nothing in it that leads elsewhere, and no blank, which a shell would part."""
    safe = re.sub(r"\s+", "-", re.sub(r"[^\w.\-\s]+", "_", name).strip(" .")) or "run"
    return RESULTS / (safe[: 100 - len(of)] + (f"-{of}" if of else ""))


def folder_of_file(path: Path, of: str = "") -> Path:
    """results/NAME of a file's name; of what lies in a folder under a name that all runs use, that of the folder."""
    if path.stem in {"results", "refine"} and path.resolve().parent.name:
        return folder_named(path.resolve().parent.name, of or "replayed")
    return folder_named(path.stem, of)


def name_of(model: str) -> str:
    """What a model is called that is named as `base`, a file, file.py:Class, or a refine's folder or refine.json."""
    file, own, name = model.rpartition(":") if ".py:" in model else (model, "", "")
    path = Path(file)
    if own and name:
        return name
    if path.is_dir() or path.name in {"refine.json", "model.yaml"}:
        inner = path if path.is_dir() else path.parent
        return inner.resolve().name or "model"
    return path.stem


def manifest_in(folder: Path) -> dict[str, Any]:
    """The manifest that a run left in a folder, empty where there is none that can be read."""
    return content_of(folder / "manifest.json")


def content_of(path: Path) -> dict[str, Any]:
    """What a JSON file of keys holds, empty where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def left_by_replay(folder: Path) -> dict[str, Any]:
    """What a replay says of its rows: `log`, `fmu`, `units`, `sentence`; empty where there is none that can be read."""
    return content_of(folder / REPLAY)


def check_ours(folder: Path, name: str = "", *, ssp: Path | None = None, force: bool = False) -> None:
    """Lock a folder; InputError if it holds what the run of another scenario or SSP, or another command, left."""
    take_folder(folder)
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


def check_left(folder: Path, by: str, *sources: str, force: bool = False) -> None:
    """Lock a folder; InputError if it holds what another command left, or the same one of other sources."""
    take_folder(folder)
    if force or not folder.is_dir():
        return
    for other in artefacts():
        if other.verb not in ("", by) and any((folder / mark).is_file() for mark in other.marks):
            raise InputError([Fault(folder, 0, 0, f"holds what `{other.verb}` left; {CURE}")])
    own = next((a for a in artefacts() if a.verb == by and a.sources), None)
    if not sources or own is None:
        return
    content = content_of(folder / own.marks[0])
    before = [str(content.get(key) or "") for key in own.sources]
    if any(before) and not all(map(_same, before, sources)):
        of = " and ".join(filter(None, before))
        raise InputError([Fault(folder, 0, 0, f"holds what `{by}` left of {of}; {CURE}")])


def _same(one: str, other: str) -> bool:
    """Two names of one file, or of one model."""
    try:
        return one == other or Path(one).resolve() == Path(other).resolve()
    except (OSError, ValueError):
        return False
