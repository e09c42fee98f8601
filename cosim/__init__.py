"""Co-simulation of FMUs, held against measured logs: what a model lacks, found and added.

`run`, `simulate`, `replay`, `refine`, `check`, `build`, `excite`, `identify`, `linearize`, `compare`, `consistency`,
`export_ssp` and `sweep` are the verbs of the command line as functions, `read` reads what they left; each is imported
when it is first asked for. docs/python.md shows them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.api import check, compare, read, refine, replay, run, simulate
    from cosim.estimators.workflow import consistency
    from cosim.experiment.excite import excite
    from cosim.identification.workflow import identify
    from cosim.linearization.workflow import linearize
    from cosim.models.fmus import build
    from cosim.simulation.export import export_ssp
    from cosim.sweeps.workflow import sweep

__all__ = [
    "build",
    "check",
    "compare",
    "consistency",
    "excite",
    "export_ssp",
    "identify",
    "linearize",
    "read",
    "refine",
    "replay",
    "run",
    "simulate",
    "sweep",
]

_PLACES = {
    "build": "cosim.models.fmus",
    "check": "cosim.api",
    "compare": "cosim.api",
    "consistency": "cosim.estimators.workflow",
    "excite": "cosim.experiment.excite",
    "export_ssp": "cosim.simulation.export",
    "identify": "cosim.identification.workflow",
    "linearize": "cosim.linearization.workflow",
    "read": "cosim.api",
    "refine": "cosim.api",
    "replay": "cosim.api",
    "run": "cosim.api",
    "simulate": "cosim.api",
    "sweep": "cosim.sweeps.workflow",
}


def __dir__() -> list[str]:
    return [*globals(), *_PLACES]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from cosim.given import checked

    function = globals()[name] = checked(getattr(import_module(_PLACES[name]), name))
    return function
