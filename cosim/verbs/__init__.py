"""Verbs: each has a module `NAME_verb` with the command `cosim NAME` and the Python function `cosim.NAME`.

A verb is registered by its entry in `VERBS`, or by the entry point of an installed package.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cosim.core.registry import VERBS as ADDED
from cosim.core.registry import ExtensionWarning, Verb, added_verbs, names

if TYPE_CHECKING:  # signatures of the functions, for type checkers
    from cosim.authoring.export import export_ssp as export_ssp
    from cosim.calibration.workflow import fit as fit
    from cosim.experiment.excite import excite as excite
    from cosim.fmi.building.build import build as build
    from cosim.linearization.workflow import linearize as linearize
    from cosim.residuals.workflow import replay as replay
    from cosim.sweeps.workflow import sweep as sweep
    from cosim.verbs.check_verb import check as check
    from cosim.verbs.compare_verb import compare as compare
    from cosim.verbs.read_verb import read as read
    from cosim.verbs.refine_verb import refine as refine
    from cosim.verbs.run_verb import run as run
    from cosim.verbs.simulate_verb import simulate as simulate

GROUPS = {  # groups and verbs in the order of `cosim -h`: name → place of the Python function
    "Simulate": {
        "run": "cosim.verbs.run_verb:run",
        "simulate": "cosim.verbs.simulate_verb:simulate",
        "init": "",
        "sweep": "cosim.sweeps.workflow:sweep",
    },
    "Compare and inspect": {
        "compare": "cosim.verbs.compare_verb:compare",
        "check": "cosim.verbs.check_verb:check",
        "info": "",
        "graph": "",
        "report": "",
        "list": "",
        "open": "",
        "view": "",
        "gc": "",
        "linearize": "cosim.linearization.workflow:linearize",
    },
    "Measured data": {
        "replay": "cosim.residuals.workflow:replay",
        "fit": "cosim.calibration.workflow:fit",
        "refine": "cosim.verbs.refine_verb:refine",
        "excite": "cosim.experiment.excite:excite",
    },
    "Build and export": {
        "build": "cosim.fmi.building.build:build",
        "export-ssp": "cosim.authoring.export:export_ssp",
        "schema": "",
    },
}
VERBS = {
    name: Verb(f"cosim.verbs.{name.replace('-', '_')}_verb:command", function, group=group)
    for group, functions in GROUPS.items()
    for name, function in functions.items()
}
VERBS["read"] = Verb(function="cosim.verbs.read_verb:read")


def verbs(only: str = "") -> Iterator[tuple[str, Verb]]:
    """Yield name and declaration of every verb, or of the one of cosim with this name.

    Warns of each package that redefines a verb of cosim.
    """
    yield from [(only, VERBS[only])] if only in VERBS else VERBS.items()
    for name in names(ADDED):
        if name in VERBS:
            text = f"{name}: an installed package registers a verb that cosim has; it is ignored"
            warnings.warn(text, ExtensionWarning, stacklevel=2)
    if only not in VERBS:
        yield from ((name, verb) for name, verb in added_verbs() if name not in VERBS)
