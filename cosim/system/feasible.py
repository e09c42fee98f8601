"""Feasibility of a scenario: its FMUs accept its steps, and its results have a manageable size."""

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
    """Note faults of communication steps that components refuse, and of results too large for the memory."""
    blocks = list(components)
    _check_size(sum(len(b.inputs) + len(b.outputs) for b in blocks), diagnosis)
    _check_sampling(blocks, diagnosis)


def _check_size(signals: int, diagnosis: Diagnosis) -> None:
    scenario = diagnosis.file.scenario
    rows = scenario.duration / scenario.step + 1.0
    size = rows * signals * BYTES
    if size > MOST_RESULTS:
        sizes = {"gigabytes": size / 1e9, "limit": MOST_RESULTS / 1e9}
        diagnosis.note(
            ("duration",),
            (
                "leaves {rows:.3g} rows of {signals} signals, {gigabytes:.3g} GB, more than {limit:g} GB; run "
                "shorter or in longer steps"
            ).format(rows=rows, signals=signals, **sizes),
        )


def _check_sampling(components: Iterable[Any], diagnosis: Diagnosis) -> None:
    file, scenario = diagnosis.file, diagnosis.file.scenario
    place = file.fault(("step",), "")
    if file.stands_in or any((f.line, f.column) == (place.line, place.column) for f in file.faults):
        return  # The step is faulty itself.
    parameter_of = cache(sampled_by)  # Several components may use the same FMU.
    for block in components:
        parameter = parameter_of(block.path) if isinstance(block, FmuBlock) else None
        if parameter is None:
            continue
        declared = next((v.start for v in block.description.modelVariables if v.name == parameter), None)
        try:
            sample = float(block.start_values.get(parameter, declared))
        except (TypeError, ValueError):
            continue
        own_step = getattr(scenario.components[block.name], "step", None)
        step = scenario.step if own_step is None else float(own_step)
        if abs(step - sample) > ROUNDING * sample:
            where = ("step",) if own_step is None else ("components", block.name, "step")
            names = {"component": block.name, "parameter": parameter}
            diagnosis.note(
                where,
                (
                    "step is {step:g} s; {component} is sampled at {sample:g} s ({parameter}): set "
                    "components.{component}.start.{parameter}, or step: {sample:g}"
                ).format(step=step, sample=sample, **names),
            )
