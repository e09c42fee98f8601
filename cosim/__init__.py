"""Co-simulation of FMUs, held against measured logs: what a model lacks, found and added.

`run`, `simulate`, `replay`, `refine`, `check`, `build`, `excite`, `identify`, `linearize`, `compare`, `consistency`,
`export_ssp` and `sweep` are the verbs of the command line as functions, `read` reads what they left; each is imported
when it is first asked for. docs/python.md shows them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.authoring.export import export_ssp
    from cosim.estimators.workflow import consistency
    from cosim.experiment.excite import excite
    from cosim.linearization.workflow import linearize
    from cosim.loading.build import build
    from cosim.sweeps.workflow import sweep
    from cosim.verbs.api import check, compare, read, refine, replay, run, simulate
    from plant.identification.workflow import identify

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
    "build": "cosim.loading.build",
    "check": "cosim.verbs.api",
    "compare": "cosim.verbs.api",
    "consistency": "cosim.estimators.workflow",
    "excite": "cosim.experiment.excite",
    "export_ssp": "cosim.authoring.export",
    "identify": "plant.identification.workflow",
    "linearize": "cosim.linearization.workflow",
    "read": "cosim.verbs.api",
    "refine": "cosim.verbs.api",
    "replay": "cosim.verbs.api",
    "run": "cosim.verbs.api",
    "simulate": "cosim.verbs.api",
    "sweep": "cosim.sweeps.workflow",
}


def __dir__() -> list[str]:
    return [*globals(), *_PLACES]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from cosim.base.settings import checked

    function = globals()[name] = checked(getattr(import_module(_PLACES[name]), name))
    return function
