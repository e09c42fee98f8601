"""FMI types: their access functions and ranges of values."""

from __future__ import annotations

import ctypes
import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

EXACT_IN_A_DOUBLE = 2**53


@dataclass(frozen=True)
class FmiType:
    """An FMI type in C.

    Attributes:
        function: Suffix of the functions fmi2Get… and fmi2Set….
        low: Smallest value; an integer for a type of whole numbers.
        high: Largest value.
        beside: True if values are stored outside the row of doubles, because doubles cannot represent them exactly.
    """

    function: str
    ctype: Any
    low: float = -math.inf
    high: float = math.inf
    beside: bool = False

    @property
    def is_whole(self) -> bool:
        """Return True if all values are integers."""
        return isinstance(self.low, int)

    @property
    def nothing(self) -> Any:
        """Return the default value of a variable without start value."""
        return {"String": "", "Binary": b""}.get(self.function, 0)

    def encode(self, value: Any) -> Any:
        """Return a value as C expects it for this FMI type; raise ValueError if it is outside the type."""
        if self.function == "String":
            return value.encode() if isinstance(value, str) else value
        if self.function == "Binary":
            try:
                return as_bytes(value)
            except ValueError:
                raise ValueError(f"{str(value)[:40]!r} is not a text of hexadecimal digits") from None
        if self.is_whole and not (math.isfinite(value) and int(value) == value):
            raise ValueError(f"{value!r} is not a whole number")
        if value < self.low or value > self.high:
            limits = f"{self.low} … {self.high}" if self.is_whole else f"±{self.high:.7g}"
            raise ValueError(f"{int(value) if self.is_whole else format(value, 'g')} is outside {limits}")
        return int(value) if self.is_whole else value


def _integer(bits: int, sign: str = "") -> FmiType:
    """Return an integer type; `sign` is "U" for an unsigned one."""
    ctype, high = getattr(ctypes, f"c_{sign.lower()}int{bits}"), 2 ** (bits if sign else bits - 1) - 1
    return FmiType(f"{sign}Int{bits}", ctype, 0 if sign else -high - 1, high, beside=bits == 64)


STRING_TYPE, INTEGER_TYPE = FmiType("String", ctypes.c_char_p, beside=True), replace(_integer(32), function="Integer")
FMI2 = {
    "Real": FmiType("Real", ctypes.c_double),
    "Integer": INTEGER_TYPE,
    "Enumeration": INTEGER_TYPE,
    "Boolean": FmiType("Boolean", ctypes.c_int, 0, 1),
    "String": STRING_TYPE,
}
FMI1 = {**FMI2, "Boolean": FmiType("Boolean", ctypes.c_ubyte, 0, 1)}
LARGEST_FLOAT32 = (2 - 2**-23) * 2.0**127
FMI3 = {
    "Float64": FmiType("Float64", ctypes.c_double),
    "Float32": FmiType("Float32", ctypes.c_float, -LARGEST_FLOAT32, LARGEST_FLOAT32),
    **{f"{sign}Int{bits}": _integer(bits, sign) for sign in ("", "U") for bits in (8, 16, 32, 64)},
    "Enumeration": FmiType("Int64", ctypes.c_int64, -EXACT_IN_A_DOUBLE, EXACT_IN_A_DOUBLE),
    "Boolean": FmiType("Boolean", ctypes.c_bool, 0, 1),
    "String": STRING_TYPE,
    "Binary": FmiType("Binary", None, beside=True),
}
DOUBLE_TYPES = ("Real", "Float64")
FLOAT_TYPES = (*DOUBLE_TYPES, "Float32")
FAMILIES = {
    **dict.fromkeys(FLOAT_TYPES, "real"),
    **dict.fromkeys(("Integer", *(k for k in FMI3 if "Int" in k), "Enumeration"), "whole"),
    "Boolean": "boolean",
    "String": "text",
    "Binary": "binary",
    "Clock": "clock",
    "": "number",  # type of a reference signal or a recording, whose values decide to which inputs it can be connected
}
FLOWS = {  # type of an output → types of inputs that accept its values without loss
    "real": {"real"},
    "whole": {"whole", "real"},
    "boolean": {"boolean", "whole", "real"},
    "text": {"text"},
    "binary": {"binary"},
    "clock": {"clock"},
    "number": {"real", "whole", "boolean"},
}


def kinds_of(version: str) -> dict[str, FmiType]:
    """Return an FMI version's supported types by name."""
    return {"1.0": FMI1, "2.0": FMI2}.get(version, FMI3)


def is_compatible(source: str, target: str) -> bool:
    """Return True if an output of type `source` may be connected to an input of type `target`."""
    return FAMILIES.get(target) in FLOWS.get(FAMILIES.get(source, "?"), ())


class Exchange:
    """Variables of one type, which a single call reads or writes; either all or none are negated aliases of FMI 1.0.

    Attributes:
        clocks: Clocks at whose ticks the values are exchanged; empty for variables without clock.
        names: Names of the scalars; an array of FMI 3.0 consists of several scalars.
        places: Indices of the scalars in the row, or in the storage beside the row.
        is_direct: True if the FMU reads and writes the row itself, as for doubles; other types use a buffer.
        finite: Number of floating-point outputs, which are the first values and must be finite.
        judged: Indices of these outputs in the row.
        buffer: Buffer of the values in transfer; for binary data a list of bytes, which FMPy sets and reads.
        arguments: Arguments of the FMI function after the instance; the last one only in FMI 3.0.
        set, get: Functions that copy the buffer to the instance or fill it from the instance, and return the FMI
            status.
    """

    set: Any
    get: Any

    def __init__(self, kind: FmiType, variables: Sequence[Any], outputs: Collection[str] = ()) -> None:
        self.kind, self.variables = kind, tuple(variables)
        self.names = tuple(name for variable in variables for name in element_names(variable))
        self.count = len(self.names)
        self.vrs = (ctypes.c_uint * len(variables))(*(v.valueReference for v in variables))
        self.negated = is_negated(variables[0])
        self.clocks = frozenset(clock.name for clock in variables[0].clocks or ())
        self.is_direct = kind.ctype is ctypes.c_double and not self.negated
        is_float = kind.ctype in (ctypes.c_double, ctypes.c_float)
        self.finite = sum(name in outputs for name in self.names) if is_float else 0
        self.places = self.judged = slice(0, 0)
        self.buffer: Any = [b""] * self.count
        if kind.ctype is not None:
            self.move_by((kind.ctype * self.count)())

    def move_by(self, buffer: Any) -> None:
        """Use `buffer` for all transfers of values to and from the FMU."""
        self.buffer = buffer
        self.arguments = ctypes.addressof(self.vrs), len(self.vrs), ctypes.addressof(buffer), self.count

    def decode(self) -> list[Any]:
        """Return the values in the buffer."""
        values: list[Any] = self.buffer[:]
        if self.kind.function == "Binary":
            return [value or b"" for value in values]  # NULL: no bytes
        if self.kind.function == "String":
            return [(value or b"").decode("utf-8", "replace") for value in values]
        return [negative(self.kind.function, value) for value in values] if self.negated else values

    def encode(self, values: Sequence[Any]) -> None:
        """Put values into the buffer; raise ValueError, with the variable's name, for values outside the type."""
        for k, (name, value) in enumerate(zip(self.names, values, strict=True)):
            try:
                self.buffer[k] = self.kind.encode(negative(self.kind.function, value) if self.negated else value)
            except (ValueError, OverflowError) as error:
                raise ValueError(f"{name}: {error}") from None


def elements(kind: FmiType, variable: Any, value: Any) -> list[Any]:
    """Return the scalars of a variable's value, as the row stores them.

    The value is from the user or from the model description.

    Raises:
        TypeError: The value is missing.
        ValueError: The text in the description does not fit the type.
    """
    is_text = kind.function in {"String", "Binary"}
    scalars = value.split() if isinstance(value, str) and not is_text else value
    scalars = list(scalars) if isinstance(scalars, (list, tuple)) else [scalars]
    count = len(element_names(variable))
    stored: list[Any] = []
    for scalar in scalars if len(scalars) == count else scalars[:1] * count:
        if scalar is None:
            raise TypeError
        if kind.function == "String":
            stored.append(str(scalar))
        elif kind.function == "Binary":
            stored.append(as_bytes(scalar))
        elif kind.function == "Boolean" and isinstance(scalar, str):
            stored.append(float(scalar in {"true", "1"}))
        else:
            stored.append(int(scalar) if kind.beside else float(scalar))
    return stored


def as_bytes(value: Any) -> bytes:
    """Return binary data from a text of hexadecimal digits; raise ValueError for other text."""
    return bytes.fromhex(value) if isinstance(value, str) else bytes(value or b"")


def is_negated(variable: Any) -> bool:
    """Return True if a variable is a negated alias of FMI 1.0."""
    return getattr(variable, "negated", False)


def input_aliases(description: Any) -> dict[str, dict[str, bool]]:
    """Return input → alias among the inputs → True if the alias has the opposite sign."""
    groups: dict[tuple[str, int], list[Any]] = {}
    for v in description.modelVariables:
        if v.causality == "input" and not v.shape:
            groups.setdefault((v.type, v.valueReference), []).append(v)
    return {
        v.name: {w.name: is_negated(w) != is_negated(v) for w in group if w is not v}
        for group in groups.values()
        if len(group) > 1
        for v in group
    }


def negative(kind: str, value: Any) -> Any:
    """Convert a value of a negated alias to the value of its value reference, or back."""
    return (1 if kind == "Boolean" else 0) - value


def element_names(variable: Any) -> list[str]:
    """Return the names of a variable's scalars: `name[1,2]` and so on for an array."""
    if not variable.shape:
        return [variable.name]
    indices = itertools.product(*(range(1, n + 1) for n in variable.shape))
    return [f"{variable.name}[{','.join(map(str, index))}]" for index in indices]
