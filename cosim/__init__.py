"""Co-simulation of FMUs, and their refinement with measured logs.

`run`, `simulate`, `replay`, `fit`, `refine`, `check`, `build`, `excite`, `linearize`, `compare`, `export_ssp`
and `sweep` are the verbs of the command line as functions; `read` reads their results. Installed packages
add more. Each is imported at its first use. docs/python.md has examples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim.verbs import *  # noqa: F403


def __dir__() -> list[str]:
    return [*globals(), *_functions()]


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return list(_functions())
    if name == "__version__":
        from cosim.core.version import __version__

        return __version__
    if name.startswith("_") or (place := _functions().get(name)) is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from cosim.core.notebook import shows_progress
    from cosim.core.registry import resolve
    from cosim.core.settings import check_arguments

    globals()[name] = shows_progress(check_arguments(resolve(place)))
    return globals()[name]


def _functions() -> dict[str, str]:
    """Return the Python functions of all verbs: name → place as `module:object`."""
    from cosim.verbs import verbs

    return {name.replace("-", "_"): verb.function for name, verb in verbs() if verb.function}
