"""Check of a log by `cosim check`, with or without a model."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cosim.core.registry import BASE, is_model
from cosim.core.text import counted
from cosim.core.units import assume_si, parse
from cosim.files.artefact import Checking
from cosim.files.table import Column, Faults, read_header
from cosim.fmi.building.file import LoadedModel, load_model
from cosim.fmi.building.own_run import predicted_outputs
from cosim.fmi.building.substep import substep_notes, with_substep
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import first_rows, read_log
from cosim.logs.model_comparison import output_findings
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.model.traits import Traits

PREDICTED_ROWS = 1000  # first rows of a log in which the model's outputs are predicted


def check_log(path: Path, checking: Checking) -> list[str]:
    """Return the findings on a log.

    The log is compared with the model of `checking`. Without a model, a log with a column for an input of the
    registered model `base` is compared with `base`; any other log is checked alone.
    """
    if checking.model is None and not is_model(BASE):
        return _findings_without_model(path, checking.columns)
    loaded = load_model(checking.model or BASE, Path())
    if checking.model is None:
        names = {checking.columns.get(name, name) for name in read_header(path)}
        if names and names.isdisjoint(q.name for q in loaded.model.inputs):
            return _findings_without_model(path, checking.columns)
    return log_findings(path, loaded, checking.columns)


def log_findings(path: Path, loaded: LoadedModel, columns: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Return the findings on a log, one line each.

    Raises:
        InputError: The log has faults.
    """
    model = loaded.model
    log = read_log(path, model.inputs, model.outputs, columns=columns)
    stepping = with_substep(loaded)[0].model
    spikes = find_spikes(log, partial(predicted_outputs, stepping, log))
    findings = gate(log, model.rate, Traits.of(model), spikes, {q.name: q.start for q in model.inputs})
    refuse_faults(log, findings)
    first = first_rows(log, PREDICTED_ROWS)
    free = predicted_outputs(stepping, first, dict.fromkeys(log.outputs, np.arange(first.rows)))
    against = output_findings(first, free)
    refuse_faults(log, against)
    findings += against
    return [*(f.line for f in findings), *substep_notes(loaded, [drop_outliers(log, spikes)])]


def _findings_without_model(path: Path, columns: Mapping[str, str]) -> list[str]:
    """Return the findings on a log without a model, one line each: clock, gaps, units, channels.

    Raises:
        InputError: The log has faults.
    """
    unknown, text = dict[str, str](), list[str]()  # column → unit that cosim does not know; columns of text

    def declare(column: Column, faults: Faults) -> str | None:
        """Return the unit of a numeric column, in SI if the header has a unit; None for text."""
        if not column.name:
            faults.note(faults.header, column.cell, "the column has no name; name it or delete it")
        elif column.holds_words:
            text.append(column.name)
        else:
            if column.unit and parse(column.unit) is None:
                unknown[column.name] = column.unit
            return assume_si(column.unit).unit if column.unit else ""
        return None

    log = read_log(path, (), (), columns=columns, declare=declare)
    findings = gate(log)
    refuse_faults(log, findings)
    lines = [f.line for f in findings]
    lines += [
        f'warning: {name}: unknown unit "{unit}"; its numbers are not converted' for name, unit in unknown.items()
    ]
    if text:
        lines.append(f"note: {counted(len(text), 'column')} of text not read: {', '.join(text)}")
    return [
        *lines,
        "note: checked without a model; use --model FILE:CLASS to compare names, units and signs with a model",
    ]
