"""FMUs that take one communication step only, held against the step of the scenario before anything runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.simulation.diagnosis import Diagnosis
from fmus.sampled import sampled_by

ROUNDING = 1e-6  # of a step, as the FMUs themselves allow


def check_sampling(components: Iterable[Any], diagnosis: Diagnosis) -> None:
    """Note a fault for each FMU that would refuse the communication step."""
    file, scenario = diagnosis.file, diagnosis.file.scenario
    stated = file.fault(("step",), "")
    if file.stands_in or any((f.line, f.column) == (stated.line, stated.column) for f in file.faults):
        return  # the step is faulty itself
    for block in components:
        parameter = sampled_by(block.path) if isinstance(block, FmuBlock) else None
        if parameter is None:
            continue
        own = next((v.start for v in block.description.modelVariables if v.name == parameter), None)
        try:
            sample = float(block.start_values.get(parameter, own))
        except (TypeError, ValueError):
            continue
        given = getattr(scenario.components[block.name], "step", None)  # a step of its own
        step = scenario.step if given is None else float(given)
        if abs(step - sample) > ROUNDING * sample:
            where = ("step",) if given is None else ("components", block.name, "step")
            cure = f"set components.{block.name}.start.{parameter}, or step: {sample:g}"
            diagnosis.note(where, f"step is {step:g} s; {block.name} is sampled at {sample:g} s ({parameter}): {cure}")
