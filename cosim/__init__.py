"""Co-simulation of FMUs, held against measured logs: what a model lacks, found and added.

`build`, `run`, `replay`, `refine`, `excite`, `identify` and `check` are the verbs of the command line as functions;
each is imported when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.checks import check_files as check
    from cosim.experiment.excite import excite
    from cosim.identification.workflow import identify
    from cosim.models.fmus import build
    from cosim.refinement.workflow import refine
    from cosim.residuals.workflow import replay
    from cosim.simulation.workflow import run

__all__ = ["build", "check", "excite", "identify", "refine", "replay", "run"]

_PLACES = {
    "build": ("cosim.models.fmus", "build"),
    "check": ("cosim.checks", "check_files"),
    "excite": ("cosim.experiment.excite", "excite"),
    "identify": ("cosim.identification.workflow", "identify"),
    "refine": ("cosim.refinement.workflow", "refine"),
    "replay": ("cosim.residuals.workflow", "replay"),
    "run": ("cosim.simulation.workflow", "run"),
}


def __dir__() -> list[str]:
    return [*globals(), *_PLACES]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PLACES[name]
    return getattr(import_module(module), attribute)
