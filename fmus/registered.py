"""Registrations of the worked example, named in examples/hovercraft/pyproject.toml."""

from __future__ import annotations

from cosim.core.registry import ModelEntry, Page, Verb
from cosim.files.artefact import Artefact

CONTROLLERS = {  # several laws with the same ports
    "controller.fmu": "fmus.recipes:controller_recipe",
    "controller-pole.fmu": "fmus.recipes:poles_recipe",
    "controller-lqi.fmu": "fmus.recipes:integral_recipe",
    "controller-mpc.fmu": "fmus.recipes:predictive_recipe",
    "controller-ltv-mpc.fmu": "fmus.recipes:time_variant_recipe",
}
HOVERCRAFT = ModelEntry(
    name="hovercraft",
    model="plant.hovercraft:Hovercraft",
    recipe="fmus.recipes:plant_recipe",
    built={
        "plant.fmu": "fmus.recipes:plant_recipe",
        "plant-heavy.fmu": "fmus.recipes:heavy_recipe",
        **CONTROLLERS,
        "filter.fmu": "fmus.recipes:filter_recipe",
        "ekf.fmu": "fmus.recipes:extended_recipe",
    },
    beside=CONTROLLERS,
    native={"controller": "fmus.controller_native:controller_native"},
    rig="controller.closed_loop:ClosedLoop",
    design="controller.designer:design",
)
BENCH = ModelEntry(name="bench", model="plant.bench:Bench", recipe="fmus.recipes:bench_recipe")
RUN_PAGE = Page(
    variables=frozenset({"x_world", "y_world", "psi"}),
    subject="fmus.report.craft:subject",
)
IDENTIFY = Verb(
    command="fmus.commands:identify_command",
    function="plant.identification.workflow:identify",
    artefacts="plant.identification:ARTEFACTS",
    group="Craft example",
)
CONSISTENCY = Verb(
    command="fmus.commands:consistency_command",
    function="controller.consistency:consistency",
    artefacts="fmus.registered:ARTEFACTS",
    group="Craft example",
)
ARTEFACTS = (
    Artefact(
        "a result of `cosim consistency`",
        "read it with a script; `cosim consistency` writes one",
        keys=(frozenset({"runs", "steps", "seed", "rows"}),),
        verb="cosim consistency",
        marks=("consistency.json",),
        files=("consistency.json", "report.html"),
        folder="the folder of a consistency test",
        folder_step="open its report.html in a browser; consistency.json is for scripts",
    ),
    Artefact(
        "a design of controllers",
        "`cosim build --model hovercraft --design {file}` builds its controllers",
        keys=tuple(frozenset({key}) for key in ("controllers", "Q", "R", "poles")),
        without=frozenset({"components", "model"}),
        schema="controller.designer:DesignFile",
        schema_name="design",
        title="cosim design of controllers",
        check="controller.designer:check_design",
    ),
)
