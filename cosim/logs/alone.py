"""Checks of a log without a model: clock, gaps, units and channels, every column as measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cosim.base.messages import Note
from cosim.base.text import counted
from cosim.base.units import assume_si, parse
from cosim.logs.finding import Finding
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import Log, LogReader
from cosim.storage.table_columns import Column, Heading


def findings_without_model(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """Return the findings on a log without a model, one line each.

    Raises:
        InputError: The log has faults.
    """
    reader = _AloneReader(path, columns)
    log = reader.log()
    findings = gate(log)
    refuse_faults(log, findings)
    return [f.line for f in (*findings, *reader.notes(log))]


class _AloneReader(LogReader):
    """Reader of a log without a model.

    Every numeric column is an output, in SI if its header has a unit. Text columns are skipped.
    """

    def __init__(self, path: Path, columns: Mapping[str, str]) -> None:
        self.unknown: dict[str, str] = {}  # column → unit unknown to the framework
        self.text: list[str] = []
        super().__init__(path, {}, {}, columns, True)

    def _column(self, heading: Heading) -> Column | None:
        if heading.cell > 1:
            heading = replace(heading, name=self.renamings.get(heading.name, heading.name))
            if not heading.name:
                self.faults.note(heading.line, heading.cell, "the column has no name; name it or delete it")
                return None
            unit = assume_si(heading.unit).unit if heading.unit else ""
            self.outputs[heading.name] = self.signals[heading.name] = self.units[heading.name] = unit
            if heading.unit and parse(heading.unit) is None:
                self.unknown[heading.name] = heading.unit
        return super()._column(heading)

    def _check_header(self) -> None:
        """Note a fault if the log has no column besides time."""
        if not self.outputs:
            self.faults.note(self.table.header, 1, "holds no column beside the time; a log holds what was measured")

    def _check_values(self) -> None:
        for name, column in list(self.table.columns.items()):
            kind = f"cells of {name} that are no number"
            if name in self.outputs and self.faults.counts[column.cell, kind] and np.isnan(self.table[name]).all():
                self._leave_out(column)
        super()._check_values()

    def _leave_out(self, column: Column) -> None:
        """Skip a text column without a fault."""
        self.text.append(column.name)
        del self.table.columns[column.name], self.table.values[column.name], self.outputs[column.name]
        for cell, kind in [key for key in self.faults.counts if key[0] == column.cell]:
            del self.faults.counts[cell, kind]
        header = self.table.header
        self.faults.items = [f for f in self.faults.items if f.column != column.cell or f.line <= header]

    def notes(self, log: Log) -> Iterator[Finding]:
        """Yield notes on text columns and unknown units."""
        for name, unit in self.unknown.items():
            if name in log.outputs:
                yield Finding(
                    "warning", "undeclared", name, f'"{unit}" is no unit known here: its numbers are taken as they are'
                )
        if count := len(self.text):
            message = f"{counted(count, 'column')} of text not read: {', '.join(self.text)}"
            yield Finding("note", "unread", "", message, {"columns": count})
        yield Finding(
            "note",
            "alone",
            "",
            Note("checked without a model: --model FILE:CLASS holds names, units and signs against one"),
        )
