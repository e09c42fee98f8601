"""Verbs: each has a module `NAME_verb` with the command `cosim NAME` and the Python function `cosim.NAME`.

A verb is registered by its entry in `VERBS`, or by the entry point of an installed package.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cosim.base.registry import VERBS as ADDED
from cosim.base.registry import ExtensionWarning, Verb, added_verbs, names

if TYPE_CHECKING:  # signatures of the functions, for type checkers
    from cosim.authoring.export import export_ssp as export_ssp
    from cosim.experiment.excite import excite as excite
    from cosim.linearization.workflow import linearize as linearize
    from cosim.loading.build import build as build
    from cosim.sweeps.workflow import sweep as sweep
    from cosim.verbs.check_verb import check as check
    from cosim.verbs.compare_verb import compare as compare
    from cosim.verbs.fit_verb import fit as fit
    from cosim.verbs.read_verb import read as read
    from cosim.verbs.refine_verb import refine as refine
    from cosim.verbs.replay_verb import replay as replay
    from cosim.verbs.run_verb import run as run
    from cosim.verbs.simulate_verb import simulate as simulate

SIMULATE, INSPECT = "Simulate", "Compare and inspect"  # groups of `cosim -h`, in this order
MEASURED, BUILD = "Measured data", "Build and export"


def _verb(room: str, group: str, function: str = "") -> Verb:
    """Return the verb of a module of cosim/verbs."""
    return Verb(f"cosim.verbs.{room}_verb:command", function, group=group)


VERBS = {  # in the order of `cosim -h`
    "run": _verb("run", SIMULATE, "cosim.verbs.run_verb:run"),
    "simulate": _verb("simulate", SIMULATE, "cosim.verbs.simulate_verb:simulate"),
    "init": _verb("init", SIMULATE),
    "sweep": _verb("sweep", SIMULATE, "cosim.sweeps.workflow:sweep"),
    "compare": _verb("compare", INSPECT, "cosim.verbs.compare_verb:compare"),
    "check": _verb("check", INSPECT, "cosim.verbs.check_verb:check"),
    "info": _verb("info", INSPECT),
    "graph": _verb("graph", INSPECT),
    "report": _verb("report", INSPECT),
    "list": _verb("list", INSPECT),
    "open": _verb("open", INSPECT),
    "view": _verb("view", INSPECT),
    "gc": _verb("gc", INSPECT),
    "linearize": _verb("linearize", INSPECT, "cosim.linearization.workflow:linearize"),
    "replay": _verb("replay", MEASURED, "cosim.verbs.replay_verb:replay"),
    "fit": _verb("fit", MEASURED, "cosim.verbs.fit_verb:fit"),
    "refine": _verb("refine", MEASURED, "cosim.verbs.refine_verb:refine"),
    "excite": _verb("excite", MEASURED, "cosim.experiment.excite:excite"),
    "build": _verb("build", BUILD, "cosim.loading.build:build"),
    "export-ssp": _verb("export_ssp", BUILD, "cosim.authoring.export:export_ssp"),
    "schema": _verb("schema", BUILD),
    "read": Verb(function="cosim.verbs.read_verb:read"),
}


def verbs(only: str = "") -> Iterator[tuple[str, Verb]]:
    """Yield name and declaration of every verb, or of one of cosim.

    Warns of each package that redefines a verb of cosim.
    """
    yield from [(only, VERBS[only])] if only else VERBS.items()
    for name in names(ADDED):
        if name in VERBS:
            warnings.warn(
                f"{name}: an installed package registers a verb that cosim has; it is ignored",
                ExtensionWarning,
                stacklevel=2,
            )
    if not only:
        yield from ((name, verb) for name, verb in added_verbs() if name not in VERBS)
