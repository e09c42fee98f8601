"""The folder that a run leaves its results in: which one without --out, and whose it is already."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from cosim.errors import Fault, InputError

RESULTS = Path("results")
OTHERS = {
    "refine.json": "cosim refine", "residual.csv": "cosim replay", "comparison.json": "cosim compare",
    "excitation.csv": "cosim excite", "sweep.json": "cosim sweep",
}  # fmt: skip


def folder_named(name: str) -> Path:
    """results/NAME, of a scenario's name with nothing in it that leads elsewhere."""
    safe = re.sub(r"[^\w.\- ]+", "_", name).strip(" .") or "run"
    return RESULTS / safe[:100]


def manifest_in(folder: Path) -> dict[str, Any]:
    """The manifest that a run left in a folder, empty where there is none that can be read."""
    try:
        content = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def check_ours(folder: Path, name: str = "", *, ssp: Path | None = None, force: bool = False) -> None:
    """InputError where a folder holds what the run of another scenario or SSP, or another command, left."""
    if force or not folder.is_dir():
        return
    manifest = manifest_in(folder)
    scenario, packed = manifest.get("scenario"), manifest.get("ssp")
    left = scenario.get("name") if isinstance(scenario, dict) else None
    if ssp is not None and isinstance(packed, dict) and packed.get("path") == str(ssp.resolve()):
        return
    by = next((verb for file, verb in OTHERS.items() if (folder / file).is_file()), None)
    if left is not None and (ssp is not None or left != name):
        what = f'holds the run of another scenario, "{left}"'
    elif by is not None:
        what = f"holds what `{by}` left"
    else:
        return
    raise InputError([Fault(folder, 0, 0, f"{what}; give another folder as --out, or write over it by --force")])
