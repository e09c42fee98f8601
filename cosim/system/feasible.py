"""Feasibility of a scenario: steps accepted by its FMUs, and results of manageable size."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.fmi.sampled import sampled_by
from cosim.scenario.diagnosis import Diagnosis

ROUNDING = 1e-6  # fraction of a step, the tolerance of the FMUs
MOST_RESULTS = 8e9  # size of results [bytes]
BYTES = 8  # size of a number [bytes]


def check_feasible(components: Iterable[Any], diagnosis: Diagnosis) -> None:
    """Note faults of refused communication steps and oversized results."""
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
        return  # The step is faulty itself.
    states = cache(sampled_by)  # Several components may use the same FMU.
    for block in components:
        parameter = states(block.path) if isinstance(block, FmuBlock) else None
        if parameter is None:
            continue
        own = next((v.start for v in block.description.modelVariables if v.name == parameter), None)
        try:
            sample = float(block.start_values.get(parameter, own))
        except (TypeError, ValueError):
            continue
        given = getattr(scenario.components[block.name], "step", None)  # the component's own step
        step = scenario.step if given is None else float(given)
        if abs(step - sample) > ROUNDING * sample:
            where = ("step",) if given is None else ("components", block.name, "step")
            cure = f"set components.{block.name}.start.{parameter}, or step: {sample:g}"
            diagnosis.note(where, f"step is {step:g} s; {block.name} is sampled at {sample:g} s ({parameter}): {cure}")
