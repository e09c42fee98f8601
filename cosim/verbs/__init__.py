"""Verbs: each has a function `NAME_command`, the command `cosim NAME`, and the Python function `cosim.NAME`.

A verb is registered by its entry in `VERBS`, or by the entry point of an installed package.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cosim.core.registry import VERBS_GROUP, ExtensionWarning, Verb, names, registered

if TYPE_CHECKING:  # signatures of the functions, for type checkers
    from cosim.authoring.export import export_ssp as export_ssp
    from cosim.authoring.single import simulate as simulate
    from cosim.calibration.workflow import fit as fit
    from cosim.experiment.excite import excite as excite
    from cosim.fmi.building.build import build as build
    from cosim.linearization.workflow import linearize as linearize
    from cosim.residuals.workflow import replay as replay
    from cosim.simulation.workflow import run as run
    from cosim.sweeps.workflow import sweep as sweep
    from cosim.verbs.checks import check as check
    from cosim.verbs.measured import refine as refine
    from cosim.verbs.results import compare as compare
    from cosim.verbs.results import read as read

GROUPS = {  # groups and verbs in the order of `cosim -h`: name → module of its command, place of the Python function
    "Simulate": {
        "run": ("runs", "cosim.simulation.workflow:run"),
        "simulate": ("runs", "cosim.authoring.single:simulate"),
        "init": ("runs", ""),
        "sweep": ("runs", "cosim.sweeps.workflow:sweep"),
    },
    "Compare and inspect": {
        "compare": ("results", "cosim.verbs.results:compare"),
        "check": ("checks", "cosim.verbs.checks:check"),
        "info": ("checks", ""),
        "graph": ("checks", ""),
        "report": ("results", ""),
        "list": ("results", ""),
        "open": ("results", ""),
        "view": ("results", ""),
        "gc": ("results", ""),
        "doctor": ("checks", ""),
        "linearize": ("checks", "cosim.linearization.workflow:linearize"),
    },
    "Measured data": {
        "replay": ("measured", "cosim.residuals.workflow:replay"),
        "fit": ("measured", "cosim.calibration.workflow:fit"),
        "refine": ("measured", "cosim.verbs.measured:refine"),
        "excite": ("measured", "cosim.experiment.excite:excite"),
    },
    "Build and export": {
        "build": ("runs", "cosim.fmi.building.build:build"),
        "export-ssp": ("runs", "cosim.authoring.export:export_ssp"),
        "schema": ("checks", ""),
    },
}
VERBS = {
    name: Verb(f"cosim.verbs.{module}:{name.replace('-', '_')}_command", function, group=group)
    for group, declared in GROUPS.items()
    for name, (module, function) in declared.items()
}
VERBS["read"] = Verb(function="cosim.verbs.results:read")


def verbs(only: str = "") -> Iterator[tuple[str, Verb]]:
    """Yield name and declaration of every verb, or only of cosim's verb `only`.

    A package that redefines a verb of cosim causes a warning.
    """
    yield from [(only, VERBS[only])] if only in VERBS else VERBS.items()
    for name in names(VERBS_GROUP):
        if name in VERBS:
            text = f"{name}: an installed package redefines this verb of cosim; its version is ignored"
            warnings.warn(text, ExtensionWarning, stacklevel=2)
    if only not in VERBS:
        yield from ((name, verb) for name, verb in registered(VERBS_GROUP, Verb) if name not in VERBS)
