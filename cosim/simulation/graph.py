"""A scenario as a picture, before it is run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from cosim.simulation.design import designed_values
from cosim.simulation.packaged import is_ssp, lay_out
from cosim.simulation.report.system import Graph, graph_from
from cosim.simulation.scenario import resolved
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.system import build_system


def graph_of(path: Path, overrides: Sequence[str] = ()) -> Graph:
    """The picture of a scenario, of a manifest's or an SSP's; InputError and FmuError as a run raises them."""
    if not is_ssp(path):
        return _graph(ScenarioFile(path, overrides))
    with tempfile.TemporaryDirectory(prefix="cosim-graph-") as made:
        return _graph(lay_out(path, Path(made), overrides)[0])


def _graph(file: ScenarioFile) -> Graph:
    system = build_system(file, designed_values(file))
    units = {name: signal.unit for name, signal in system.signals.items()}
    arrays = {f"{n.partition('.')[0]}.{s.array}": s.unit for n, s in system.signals.items() if s.array}
    held = {transfer.name for transfer in system.held}
    order = [stage.component.name for stage in system.stages]
    return graph_from(resolved(file.scenario), order, held, {**arrays, **units})
