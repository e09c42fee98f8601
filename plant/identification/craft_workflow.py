"""Workflow for logs of a craft: analysis, model.yaml, identify.json and report."""

from __future__ import annotations

from pathlib import Path

from cosim.storage.files import check_writable
from cosim.storage.yaml_file import YamlFile
from plant.identification.craft import CraftOutcome, read_craft
from plant.identification.craft_report import page
from plant.identification.distance import distance
from plant.identification.rest_noise import noise
from plant.identification.write import RECORD, REPORT, model_text, write

FILES = ("model.yaml", RECORD, REPORT)


def identify_craft(yaml: YamlFile, out: Path, *, report: bool = True) -> CraftOutcome:
    """Analyse logs of a craft and write results.

    The files of an earlier identification are replaced.

    Raises:
        InputError: Every fault of the file and its logs.
    """
    craft = read_craft(yaml)
    check_writable(out, FILES, craft.files)
    outcome, file = CraftOutcome(craft), craft.file
    if file.rest is not None:
        outcome.results.append(noise(craft.rest, craft.loaded.model, file.rest.window))
    if file.distance is not None:
        parameter, output = file.distance.parameter, file.distance.output
        outcome.results.append(distance(craft.runs, craft.loaded, parameter, output, craft.distances))
    draw = (lambda: page(outcome)) if report else None
    write(out, (FILES[0], _model(outcome)), {"name": file.name}, outcome.results, draw, read=craft.files)
    return outcome


def _model(outcome: CraftOutcome) -> str:
    loaded = outcome.craft.loaded
    identified = {e.name: e for r in outcome.results if r.test == "distance" for e in r.estimates}
    values = {**loaded.parameters, **{n: e.value for n, e in identified.items()}}
    return model_text(loaded.source, values, loaded.sensors, identified, "runs")
