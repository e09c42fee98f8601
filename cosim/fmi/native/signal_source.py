"""Native FMU without inputs: steps and ramps in time, as tables above `source.c`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.base.units import parse
from cosim.fmi.model_description import Description
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.native.layout import VariableLayout
from cosim.fmi.native.package import Native, build_native, part
from cosim.fmi.native.printing import GeneratedSources, variable_tables
from cosim.fmi.ports import Port

ALWAYS = -1e300  # before any time [s]
TEXT = "<p>Outputs that are functions of time: steps, ramps, recorded values.</p>"
__all__ = ["CompilerFailed", "NoCompiler", "SignalChange", "TimeSignal", "build_source"]


@dataclass(frozen=True)
class SignalChange:
    """A change of a signal at time `at` [s]; `rate` per second, 0 for a step."""

    at: float
    begin: float
    to: float
    rate: float = 0.0


@dataclass(frozen=True)
class TimeSignal:
    """An output as a function of time: first value, and changes in order of time."""

    unit: str
    begin: float
    changes: Sequence[SignalChange]

    @property
    def pieces(self) -> tuple[SignalChange, ...]:
        """Return the first value and the changes."""
        return (SignalChange(ALWAYS, self.begin, self.begin), *self.changes)


def build_source(
    name: str, signals: Mapping[str, TimeSignal], path: Path, step: float = 0.01, stop: float = 10.0
) -> Path:
    """Write an FMU with the signals as outputs, completely or not at all.

    Args:
        step: Step size of its default experiment [s].
        stop: Stop time of its default experiment [s].

    Raises:
        NoCompiler: No compiler exists.
        CompilerFailed: Compilation failed.
    """
    return build_native(native_source(name, signals, step, stop), path).path


def native_source(name: str, signals: Mapping[str, TimeSignal], step: float, stop: float) -> Native:
    """Return the parts of the signals' native FMU."""
    units = {output: signal.unit if parse(signal.unit) else "" for output, signal in signals.items()}
    ports = tuple(Port(output, "output", 0.0, unit, "a function of time") for output, unit in units.items())
    none: dict[str, Sequence[str]] = {port.name: () for port in ports}
    about = Description("Signals that step and ramp in time", ports, none, none, step, stop, variable_step=True)
    variables, texts = variable_tables(ports)
    sizes = {"VARIABLES": len(ports), "OUTPUTS": len(ports), "TEXTS": texts}
    sizes |= dict.fromkeys(("INPUTS", "STATES", "MEMORIES", "KINKS", "RANGES", "EFFECTS", "OWN", "EXCHANGE"), 0)
    identifier = re.sub(r"[^A-Za-z0-9_]", "_", f"source_{name}")
    parts = {file: part(file) for file in ("source.c", "steps_only.c")}
    return Native(
        identifier,
        VariableLayout(about),
        GeneratedSources(f"{variables}\n{tables(signals, step)}\n", sizes),
        parts,
        TEXT,
    )


def tables(signals: Mapping[str, TimeSignal], step: float) -> str:
    """Return the step and the C tables of all changes of the signals."""
    changes = [change for signal in signals.values() for change in signal.pieces]
    columns = {
        "AT": [c.at for c in changes],
        "FROM": [c.begin for c in changes],
        "TO": [c.to for c in changes],
        "RATE": [c.rate for c in changes],
    }
    counts = ", ".join(str(len(signal.pieces)) for signal in signals.values())
    lines = [f"static const double GRID = {step.hex()};", f"static const int CHANGES[] = {{{counts}}};"]
    for name, column in columns.items():
        lines.append(f"static const double {name}[] = {{")
        lines += ["    " + ", ".join(v.hex() for v in column[k : k + 6]) + "," for k in range(0, len(column), 6)]
        lines.append("};")
    return "\n".join(lines)
