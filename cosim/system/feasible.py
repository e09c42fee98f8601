"""What a scenario asks for and no run can give: steps that an FMU refuses, results that no machine holds."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.fmi.sampled import sampled_by
from cosim.scenario.diagnosis import Diagnosis

ROUNDING = 1e-6  # of a step, as the FMUs themselves allow
MOST_RESULTS = 8e9  # bytes
BYTES = 8  # a number


def check_feasible(components: Iterable[Any], diagnosis: Diagnosis) -> None:
    """Note a fault for each FMU that would refuse the communication step, and for results that are too large."""
    blocks = list(components)
    _check_size(sum(len(b.inputs) + len(b.outputs) for b in blocks), diagnosis)
    _check_sampling(blocks, diagnosis)


def _check_size(signals: int, diagnosis: Diagnosis) -> None:
    scenario = diagnosis.file.scenario
    rows = scenario.duration / scenario.step + 1.0
    if rows * signals * BYTES > MOST_RESULTS:
        size = f"{rows:.3g} rows of {signals} signals, {rows * signals * BYTES / 1e9:.3g} GB"
        diagnosis.note(
            ("duration",), f"leaves {size}, more than {MOST_RESULTS / 1e9:g} GB; run shorter or in longer steps"
        )


def _check_sampling(components: Iterable[Any], diagnosis: Diagnosis) -> None:
    file, scenario = diagnosis.file, diagnosis.file.scenario
    stated = file.fault(("step",), "")
    if file.stands_in or any((f.line, f.column) == (stated.line, stated.column) for f in file.faults):
        return  # the step is faulty itself
    states = cache(sampled_by)  # several components may be of one FMU
    for block in components:
        parameter = states(block.path) if isinstance(block, FmuBlock) else None
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
