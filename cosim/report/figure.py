"""Figures by matplotlib, which also works for users without a home folder."""

from __future__ import annotations

import io
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.core.scratch import process_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VARIABLE = "MPLCONFIGDIR"


def new_figure(width: float = 0.0, height: float = 0.0) -> Figure:
    """Return an empty figure of this width and height [inch], by default those of matplotlib."""
    if "matplotlib" not in sys.modules and VARIABLE not in os.environ:
        home = Path(os.path.expanduser("~"))
        settings = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
        cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
        for folder in (settings / "matplotlib", cache / "matplotlib"):
            existing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
            if not (folder.is_absolute() and existing.is_dir() and os.access(existing, os.W_OK)):
                # otherwise matplotlib makes a folder and warns
                os.environ[VARIABLE] = str(process_folder() / "matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height) if width else None, layout="constrained")
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]  # for notebooks without %matplotlib
    return figure


def _png(figure: Figure) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return picture.getvalue()
