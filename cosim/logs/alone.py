"""Checks of a log without a model: clock, gaps, units and channels, every column as measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from cosim.base.messages import Note
from cosim.base.text import counted
from cosim.base.units import assume_si, parse
from cosim.logs.finding import Finding
from cosim.logs.gate import gate, refuse_faults
from cosim.logs.log import Log, LogReader
from cosim.storage.table import Column, Use


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
        super().__init__(path, {}, {}, columns)

    def _use(self, column: Column) -> Use | None:
        if column.cell > 1:
            column = replace(column, name=self.renamings.get(column.name, column.name))
            if not column.name:
                self.faults.note(self.faults.header, column.cell, "the column has no name; name it or delete it")
                return None
            if column.holds_words:
                self.text.append(column.name)
                return None
            unit = assume_si(column.unit).unit if column.unit else ""
            self.outputs[column.name] = self.signals[column.name] = self.units[column.name] = unit
            if column.unit and parse(column.unit) is None:
                self.unknown[column.name] = column.unit
        return super()._use(column)

    def _check_header(self) -> None:
        """Note a fault if the log has no column besides time."""
        if not (self.outputs or self.text):
            self.faults.note(self.table.header, 1, "holds no column beside the time; a log holds what was measured")

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
