"""The verbs: a module `NAME_verb` each, with the command `cosim NAME` and the function `cosim.NAME` of Python.

A verb is registered by its line in `VERBS`, or by the entry point of an installed package.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cosim.base.registry import ExtensionWarning, Verb, added_verbs

if TYPE_CHECKING:  # signatures of the functions, for type checkers
    from cosim.authoring.export import export_ssp as export_ssp
    from cosim.estimators.workflow import consistency as consistency
    from cosim.experiment.excite import excite as excite
    from cosim.linearization.workflow import linearize as linearize
    from cosim.loading.build import build as build
    from cosim.sweeps.workflow import sweep as sweep
    from cosim.verbs.check_verb import check as check
    from cosim.verbs.compare_verb import compare as compare
    from cosim.verbs.read_verb import read as read
    from cosim.verbs.refine_verb import refine as refine
    from cosim.verbs.replay_verb import replay as replay
    from cosim.verbs.run_verb import run as run
    from cosim.verbs.simulate_verb import simulate as simulate

VERBS = {  # in the order of `cosim --help`
    "run": Verb("cosim.verbs.run_verb:command", "cosim.verbs.run_verb:run"),
    "build": Verb("cosim.verbs.build_verb:command", "cosim.loading.build:build"),
    "export-ssp": Verb("cosim.verbs.export_ssp_verb:command", "cosim.authoring.export:export_ssp"),
    "check": Verb("cosim.verbs.check_verb:command", "cosim.verbs.check_verb:check"),
    "replay": Verb("cosim.verbs.replay_verb:command", "cosim.verbs.replay_verb:replay"),
    "refine": Verb("cosim.verbs.refine_verb:command", "cosim.verbs.refine_verb:refine"),
    "excite": Verb("cosim.verbs.excite_verb:command", "cosim.experiment.excite:excite"),
    "info": Verb("cosim.verbs.info_verb:command"),
    "init": Verb("cosim.verbs.init_verb:command"),
    "simulate": Verb("cosim.verbs.simulate_verb:command", "cosim.verbs.simulate_verb:simulate"),
    "compare": Verb("cosim.verbs.compare_verb:command", "cosim.verbs.compare_verb:compare"),
    "report": Verb("cosim.verbs.report_verb:command"),
    "graph": Verb("cosim.verbs.graph_verb:command"),
    "schema": Verb("cosim.verbs.schema_verb:command"),
    "linearize": Verb("cosim.verbs.linearize_verb:command", "cosim.linearization.workflow:linearize"),
    "consistency": Verb("cosim.verbs.consistency_verb:command", "cosim.estimators.workflow:consistency"),
    "sweep": Verb("cosim.verbs.sweep_verb:command", "cosim.sweeps.workflow:sweep"),
    "read": Verb(function="cosim.verbs.read_verb:read"),
}


def verbs() -> Iterator[tuple[str, Verb]]:
    """Yield every verb by name, those of installed packages last; one that bears a name of ours is a warning."""
    yield from VERBS.items()
    for name, verb in added_verbs():
        if name in VERBS:
            message = f"{name}: an installed package registers a verb that cosim has; it is left out"
            warnings.warn(message, ExtensionWarning, stacklevel=2)
        else:
            yield name, verb
