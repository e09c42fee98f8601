"""Native FMUs without states: signals of steps and ramps (`source.c`), and a linear conversion (`gain.c`)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.core.units import parse
from cosim.fmi.model_description import Description
from cosim.fmi.native.package import Native, build_native, part
from cosim.fmi.native.printing import table
from cosim.fmi.ports import Port

ALWAYS = -1e300  # before any time [s]
DOCUMENTATION = "<p>Outputs that are functions of time or of one input.</p>"


@dataclass(frozen=True)
class SignalChange:
    """A change of a signal at time `at` [s]: a step (`rate` 0), or a ramp with `rate` per second."""

    at: float
    begin: float
    to: float
    rate: float = 0.0


@dataclass(frozen=True)
class TimeSignal:
    """An output as a function of time: a first value, and changes in the order of time."""

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
    # a constant value from the beginning of time, then one piece per change
    pieces = [(SignalChange(ALWAYS, s.begin, s.begin), *s.changes) for s in signals.values()]
    body = f"static const double GRID = {step.hex()};\n{table('int', 'CHANGES', (str(len(p)) for p in pieces))}"
    for column, attribute in (("AT", "at"), ("FROM", "begin"), ("TO", "to"), ("RATE", "rate")):
        body += table("double", column, (getattr(change, attribute).hex() for each in pieces for change in each))
    return _build(f"source_{name}", about, body, "source.c", path)


def build_gain(name: str, linear: tuple[float, float], units: tuple[str, str], path: Path, step: float = 0.01) -> Path:
    """Write an FMU that computes y = factor·u + offset, completely or not at all.

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
    body = table("double", "FACTOR", [factor.hex()]) + table("double", "OFFSET", [offset.hex()])
    return _build(f"gain_{name}", about, body, "gain.c", path)


def _build(name: str, about: Description, body: str, file: str, path: Path) -> Path:
    parts = {each: part(each) for each in (file, "stateless.c", "steps_only.c")}
    identifier = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return build_native(Native(identifier, about, body, {}, parts, DOCUMENTATION), path).path
