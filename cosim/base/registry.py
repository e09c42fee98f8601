"""What is known by name, and where it is: the one place in which general rooms and a particular craft meet.

Nothing named here is imported before it is asked for, so that a study of another model never loads it.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Page:
    """A page about components that have these variables.

    subject: `module:function` of (run, drawing), the `Subject` it shows; figures: of (run, folder), the
             files it drew, or "" for those of any run
    """

    variables: frozenset[str]
    subject: str
    figures: str


@dataclass(frozen=True)
class Known:
    """A model that goes by a name, and what belongs to it; each `module:name`, "" where there is none.

    model:   its class
    recipe:  of its FMU, from parameter values
    built:   file → recipe: what `cosim build` makes without a model named; beside: FMUs made with any model of it
    native:  name → what makes a native FMU beside its own
    rig:     what plays its experiments
    design:  the designer of its controller, behind `design:` of a scenario
    cases:   its estimators and truths to hold them against; estimators: of (case, runs, steps, random numbers), the
             normalised errors and innovations of one
    """

    model: str
    recipe: str
    built: Mapping[str, str]
    beside: Mapping[str, str]
    native: Mapping[str, str] = field(default_factory=dict)
    rig: str = ""
    design: str = ""
    cases: str = ""
    estimators: str = ""


LAWS = {  # the craft's controller under another law, with the same ports
    "controller-pole.fmu": "fmus.recipes:poles_recipe",
    "controller-lqi.fmu": "fmus.recipes:integral_recipe",
    "controller-mpc.fmu": "fmus.recipes:predictive_recipe",
    "controller-ltv-mpc.fmu": "fmus.recipes:time_variant_recipe",
}
BASE = "base"  # the first of these
MODELS = {
    "hovercraft": Known(
        model="plant.hovercraft:Hovercraft",
        recipe="fmus.recipes:plant_recipe",
        built={
            "plant.fmu": "fmus.recipes:plant_recipe",
            "controller.fmu": "fmus.recipes:controller_recipe",
            "plant-heavy.fmu": "fmus.recipes:heavy_recipe",
            **LAWS,
            "filter.fmu": "fmus.estimator_recipes:filter_recipe",
            "ekf.fmu": "fmus.estimator_recipes:extended_recipe",
        },
        beside={"controller.fmu": "fmus.recipes:controller_recipe", **LAWS},
        native={"controller": "fmus.controller_native:controller_native"},
        rig="controller.closed_loop:ClosedLoop",
        design="controller.designer:DESIGNER",
        cases="controller.monte_carlo:CASES",
        estimators="controller.monte_carlo:squares_of",
    ),
    "bench": Known(model="plant.bench:Bench", recipe="fmus.recipes:bench_recipe", built={}, beside={}),
}
BASE_NAME = next(iter(MODELS))
# modelName of an FMU that is no model of equations → what does the same for many runs at once (cosim/sweeps/twins.py)
TWINS = {"HovercraftController": "controller.many:Controllers"}
SCHEMAS = {"protocol": "plant.identification.protocol:ProtocolFile"}  # kind of file → what describes its keys
PAGES = (
    Page(
        frozenset({"x_world", "y_world", "psi"}),
        "fmus.report.craft_page:subject",
        "fmus.report.png_figures:figures",
    ),
)


def page_for(components: Iterable[Collection[str]]) -> Page | None:
    """The page for a run with components of these variables, if there is one."""
    sets = [set(variables) for variables in components]
    return next((page for page in PAGES if any(page.variables <= variables for variables in sets)), None)


def known(kind: type) -> Known | None:
    """What is known of a class of models, or of the nearest it is made from, by where that stands."""
    places = (f"{parent.__module__}:{parent.__qualname__}" for parent in kind.__mro__)
    return next((k for place in places for k in MODELS.values() if k.model == place), None)


def rig_of(kind: type, otherwise: Any) -> Any:
    """What plays experiments of a class of models."""
    entry = known(kind)
    return resolve(entry.rig) if entry and entry.rig else otherwise


def resolve(place: str) -> Any:
    """The object at `module:name`, imported now."""
    return pkgutil.resolve_name(place)
