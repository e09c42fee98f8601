"""Co-simulation of FMUs, and their refinement with measured logs.

`run`, `simulate`, `replay`, `refine`, `check`, `build`, `excite`, `linearize`, `compare`, `consistency`, `export_ssp`
and `sweep` are the verbs of the command line as functions, `read` reads what they left. Installed packages add more.
Each is imported when it is first asked for. docs/python.md shows them.
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

__all__ = [
    "build",
    "check",
    "compare",
    "consistency",
    "excite",
    "export_ssp",
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
    from cosim.base.settings import checked

    if name in _PLACES:
        function = getattr(import_module(_PLACES[name]), name)
    elif (function := _added(name)) is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = checked(function)
    return globals()[name]


def _added(name: str) -> Any:
    """Return the function that an installed package adds under a name; None if there is none."""
    if name.startswith("_"):
        return None
    from cosim.base.registry import extensions, resolve

    places = (e.function for command, e in extensions() if e.function and command.replace("-", "_") == name)
    place = next(places, None)
    return None if place is None else resolve(place)
