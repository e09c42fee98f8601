"""Check of a log by `cosim check`, against a model or alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cosim.base.registry import BASE, is_model
from cosim.loading.file import LoadedModel, load_model
from cosim.loading.own_run import predicted_outputs
from cosim.loading.substep import substep_notes, with_substep
from cosim.logs.alone import findings_without_model
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import first_rows, read_log
from cosim.logs.model_comparison import output_findings
from cosim.logs.spikes import drop_outliers, find_spikes
from cosim.logs.unit_mistakes import input_unit_findings
from cosim.model.traits import Traits
from cosim.storage.artefact import Checking
from cosim.storage.table import read_header

ROWS = 1000  # first rows of a log in which the model's outputs are predicted


def check_log(path: Path, checking: Checking) -> list[str]:
    """Return the findings on a log.

    The log is compared with the named model, by default with the base model if an input matches, else with no model.
    """
    if checking.model is None and not is_model(BASE):
        return findings_without_model(path, checking.columns)
    loaded = load_model(checking.model or BASE, Path())
    if checking.model is None:
        names = {checking.columns.get(name, name) for name in read_header(path)}
        if names and names.isdisjoint(q.name for q in loaded.model.inputs):
            return findings_without_model(path, checking.columns)
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
    traits = Traits.of(model)
    findings = gate(log, model.rate, traits=traits, spikes=spikes)
    findings += input_unit_findings(log, {q.name: q.start for q in model.inputs}, traits.bounds)
    refuse_faults(log, findings)
    first = first_rows(log, ROWS)
    free = predicted_outputs(stepping, first, dict.fromkeys(log.outputs, np.arange(first.rows)))
    against = output_findings(first, free)
    refuse_faults(log, against)
    findings += against
    return [*(f.line for f in findings), *substep_notes(loaded, [drop_outliers(log, spikes)])]
