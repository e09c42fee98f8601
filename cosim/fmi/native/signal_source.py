"""Native FMUs without states: signals of steps and ramps (`source.c`), and a linear conversion (`gain.c`)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.core.units import parse
from cosim.fmi.model_description import Description
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.native.package import Native, build_native, part
from cosim.fmi.native.printing import variable_tables
from cosim.fmi.ports import Port

ALWAYS = -1e300  # before any time [s]
TEXT = "<p>Outputs that are functions of time or of one input.</p>"
__all__ = ["CompilerFailed", "NoCompiler", "SignalChange", "TimeSignal", "build_gain", "build_source"]


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
    # a constant piece from the beginning of time, then the changes
    pieces = [(SignalChange(ALWAYS, s.begin, s.begin), *s.changes) for s in signals.values()]
    changes = [change for each in pieces for change in each]
    columns = {
        "AT": [c.at for c in changes],
        "FROM": [c.begin for c in changes],
        "TO": [c.to for c in changes],
        "RATE": [c.rate for c in changes],
    }
    lines = [f"static const double GRID = {step.hex()};"]
    lines.append(f"static const int CHANGES[] = {{{', '.join(str(len(each)) for each in pieces)}}};")
    for column, values in columns.items():
        lines.append(f"static const double {column}[] = {{")
        lines += ["    " + ", ".join(v.hex() for v in values[k : k + 6]) + "," for k in range(0, len(values), 6)]
        lines.append("};")
    return _build(f"source_{name}", about, lines, "source.c", path)


def build_gain(name: str, linear: tuple[float, float], units: tuple[str, str], path: Path, step: float = 0.01) -> Path:
    """Write an FMU with y = factor·u + offset, completely or not at all.

    Args:
        linear: Factor and offset.
        units: Units of u and y.

    Raises:
        NoCompiler: No compiler exists.
        CompilerFailed: Compilation failed.
    """
    (factor, offset), (unit, to) = linear, (unit if parse(unit) else "" for unit in units)
    ports = (
        Port("u", "input", 0.0, unit, "value to convert"),
        Port("y", "output", offset, to, f"{factor!r}*u + {offset!r}"),
    )
    about = Description("Conversion of a signal", ports, {"y": ("u",)}, {"y": ("u",)}, step, 10.0, variable_step=True)
    lines = [
        f"static const double FACTOR[] = {{{factor.hex()}}};",
        f"static const double OFFSET[] = {{{offset.hex()}}};",
    ]
    return _build(f"gain_{name}", about, lines, "gain.c", path)


def _build(name: str, about: Description, lines: Sequence[str], file: str, path: Path) -> Path:
    variables, texts = variable_tables(about.ports)
    inputs = sum(port.causality == "input" for port in about.ports)
    sizes = {"VARIABLES": len(about.ports), "INPUTS": inputs, "OUTPUTS": len(about.ports) - inputs, "TEXTS": texts}
    sizes |= dict.fromkeys(("STATES", "MEMORIES", "KINKS", "RANGES", "EFFECTS", "OWN", "EXCHANGE"), 0)
    parts = {each: part(each) for each in (file, "stateless.c", "steps_only.c")}
    identifier = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return build_native(Native(identifier, about, "\n".join([variables, *lines, ""]), sizes, parts, TEXT), path).path
