"""Native FMU without inputs: steps and ramps in time, as tables above `source.c`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.core.units import parse
from cosim.fmi.model_description import Description
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.native.native_description import Native
from cosim.fmi.native.package import build_native, part
from cosim.fmi.native.printing import variable_tables
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
    units = {output: signal.unit if parse(signal.unit) else "" for output, signal in signals.items()}
    ports = tuple(Port(output, "output", 0.0, unit, "a function of time") for output, unit in units.items())
    none: dict[str, Sequence[str]] = {port.name: () for port in ports}
    about = Description("Signals that step and ramp in time", ports, none, none, step, stop, variable_step=True)
    variables, texts = variable_tables(ports)
    sizes = {"VARIABLES": len(ports), "OUTPUTS": len(ports), "TEXTS": texts}
    sizes |= dict.fromkeys(("INPUTS", "STATES", "MEMORIES", "KINKS", "RANGES", "EFFECTS", "OWN", "EXCHANGE"), 0)
    # a constant piece from the beginning of time, then the changes
    pieces = [(SignalChange(ALWAYS, s.begin, s.begin), *s.changes) for s in signals.values()]
    changes = [change for each in pieces for change in each]
    columns = {
        "AT": [c.at for c in changes],
        "FROM": [c.begin for c in changes],
        "TO": [c.to for c in changes],
        "RATE": [c.rate for c in changes],
    }
    lines = [variables, f"static const double GRID = {step.hex()};"]
    lines.append(f"static const int CHANGES[] = {{{', '.join(str(len(each)) for each in pieces)}}};")
    for column, values in columns.items():
        lines.append(f"static const double {column}[] = {{")
        lines += ["    " + ", ".join(v.hex() for v in values[k : k + 6]) + "," for k in range(0, len(values), 6)]
        lines.append("};")
    identifier = re.sub(r"[^A-Za-z0-9_]", "_", f"source_{name}")
    parts = {file: part(file) for file in ("source.c", "steps_only.c")}
    return build_native(Native(identifier, about, "\n".join([*lines, ""]), sizes, parts, TEXT), path).path
