"""Result of a protocol: every number with both estimators."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cosim.storage.kinds import shell_path
from plant.identification.cells import Cells
from plant.identification.estimates import Estimate, Result
from plant.identification.protocol import Protocol
from plant.identification.recordings import Recording


@dataclass
class Outcome:
    """Result of a bench protocol: cells, results of the tests, and recordings by test."""

    protocol: Protocol
    cells: Cells
    results: list[Result]
    recordings: dict[str, list[Recording]] = field(default_factory=dict)

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Return the estimates by `test.name`."""
        return {f"{r.test}.{e.name}": e for r in self.results for e in r.estimates}

    @property
    def estimates_by_name(self) -> dict[str, Estimate]:
        """Return estimates by name without the test; for the lag, a step test has priority over sines."""
        by_name: dict[str, Estimate] = {}
        for e in self.estimates.values():
            by_name.setdefault(e.name, e)
        return by_name

    @property
    def warnings(self) -> list[str]:
        """Return the warnings, preceded by their test's name."""
        return [f"{r.test}: {message}" for r in self.results for message in r.warnings]

    def closing(self, out: Path) -> str:
        """Return the sentence on powertrain.yaml and the command that builds an FMU of it."""
        file = out / "powertrain.yaml"
        return f"power-train: {file}, built by: cosim build --model {shell_path(file)}"

    @property
    def sentences(self) -> list[str]:
        """Return a line for each estimate: value, confidence interval, value as in the thesis, true value."""
        lines = []
        for key, e in self.estimates.items():
            unit = "" if e.unit == "1" else f" {e.unit}"
            thesis = "no value" if np.isnan(e.thesis) else f"{e.thesis:.5g}"
            truth = "" if np.isnan(e.truth) else f"; true {e.truth:.6g}"
            lines.append(
                f"{key} = {e.value:.5g}{unit} (95 % {e.low:.5g} … {e.high:.5g}; as the thesis {thesis}{truth})"
            )
        return lines


def plain_values(value: Any) -> Any:
    """Return values for JSON, with null for missing numbers."""
    if isinstance(value, dict):
        return {str(k): plain_values(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
