"""Figures by matplotlib, which also works for users without a home folder."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.base.scratch import process_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VARIABLE = "MPLCONFIGDIR"


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size [inch]."""
    if "matplotlib" not in sys.modules and VARIABLE not in os.environ and not _has_place():
        os.environ[VARIABLE] = str(process_folder() / "matplotlib")  # otherwise matplotlib makes a folder and warns
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _has_place() -> bool:
    """Return whether matplotlib can write its settings and its font list to the user's folders."""
    home = Path(os.path.expanduser("~"))
    settings = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return all(_is_writable(folder / "matplotlib") for folder in (settings, cache))


def _is_writable(folder: Path) -> bool:
    """Return whether the folder can be written, or created in the first folder above it that exists."""
    existing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
    return folder.is_absolute() and existing.is_dir() and os.access(existing, os.W_OK)
