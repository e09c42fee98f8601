"""The types of FMI: by which functions their values are moved, and which values they hold."""

from __future__ import annotations

import ctypes
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

EXACT_IN_A_DOUBLE = 2**53


@dataclass(frozen=True)
class Kind:
    """A type as C has it.

    function:  its functions are fmi2Get… and fmi2Set… of this
    low, high: the whole numbers that it holds; None of one that holds others
    beside:    values that no double holds exactly, so they stand beside the row of doubles
    largest:   of one that holds no whole numbers, the largest amount
    """

    function: str
    ctype: Any
    low: int | None = None
    high: int | None = None
    beside: bool = False
    largest: float = math.inf

    def encoded(self, value: Any) -> Any:
        """A value as C takes it; ValueError where it is outside the type."""
        if self.function == "String":
            return value.encode() if isinstance(value, str) else value
        if self.low is None or self.high is None:
            if self.largest < math.inf and abs(value) > self.largest:
                raise ValueError(f"{value:g} is outside ±{self.largest:.7g}")
            return value
        whole = int(value) if math.isfinite(value) else None
        if whole is None or whole != value:
            raise ValueError(f"{value!r} is no whole number")
        if not self.low <= whole <= self.high:
            raise ValueError(f"{whole} is outside {self.low} … {self.high}")
        return whole


def _integer(function: str, bits: int, signed: bool) -> Kind:
    ctype = getattr(ctypes, f"c_{'' if signed else 'u'}int{bits}")
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return Kind(function, ctype, low, high, beside=bits == 64)


REAL, TEXT = Kind("Real", ctypes.c_double), Kind("String", ctypes.c_char_p, beside=True)
INTEGER = _integer("Integer", 32, True)
FMI2 = {
    "Real": REAL,
    "Integer": INTEGER,
    "Enumeration": INTEGER,
    "Boolean": Kind("Boolean", ctypes.c_int, 0, 1),
    "String": TEXT,
}
FMI1 = {**FMI2, "Boolean": Kind("Boolean", ctypes.c_ubyte, 0, 1)}
FMI3 = {
    "Float64": Kind("Float64", ctypes.c_double),
    "Float32": Kind("Float32", ctypes.c_float, largest=(2 - 2**-23) * 2.0**127),
    **{f"Int{bits}": _integer(f"Int{bits}", bits, True) for bits in (8, 16, 32, 64)},
    **{f"UInt{bits}": _integer(f"UInt{bits}", bits, False) for bits in (8, 16, 32, 64)},
    "Enumeration": Kind("Int64", ctypes.c_int64, -EXACT_IN_A_DOUBLE, EXACT_IN_A_DOUBLE),
    "Boolean": Kind("Boolean", ctypes.c_bool, 0, 1),
    "String": TEXT,
    "Binary": Kind("Binary", None, beside=True),
}
FAMILIES = {
    **dict.fromkeys(("Real", "Float32", "Float64"), "real"),
    **dict.fromkeys(("Integer", *(k for k in FMI3 if "Int" in k), "Enumeration"), "whole"),
    "Boolean": "boolean",
    "String": "text",
    "Binary": "binary",
    "": "number",  # of a reference or a recording: it fits where its values do
}
FLOWS = {  # a signal goes where none of its values is lost
    "real": {"real"},
    "whole": {"whole", "real"},
    "boolean": {"boolean", "whole", "real"},
    "text": {"text"},
    "binary": {"binary"},
    "number": {"real", "whole", "boolean"},
}


def kinds_of(version: str) -> dict[str, Kind]:
    """Types of an FMI version by their name in the description; what is missing, such as Clock, is not supported."""
    return FMI1 if version == "1.0" else FMI2 if version == "2.0" else FMI3


def goes(source: str, target: str) -> bool:
    """An output of one type may be connected to an input of the other."""
    return FAMILIES.get(target) in FLOWS.get(FAMILIES.get(source, "?"), ())


class Exchange:
    """Variables of one type, read or written in one call.

    names:  of their scalars: an array of FMI 3.0 has several
    places: where these stand, in the row or beside it
    """

    def __init__(self, kind: Kind, variables: Sequence[Any]) -> None:
        self.kind, self.variables = kind, tuple(variables)
        self.names = tuple(name for variable in variables for name in element_names(variable))
        self.count = len(self.names)
        self.vrs = (ctypes.c_uint * len(variables))(*(v.valueReference for v in variables))
        self.buffer: Any = (kind.ctype * self.count)() if kind.ctype is not None else None
        self.places = slice(0, 0)

    def arguments(self, fmi3: bool, address: int | None = None) -> tuple[Any, ...]:
        """What FMI's functions take behind the instance: on this buffer, or on the one at `address`."""
        where = ctypes.addressof(self.buffer) if address is None else address
        given = (ctypes.addressof(self.vrs), len(self.vrs), where)
        return (*given, self.count) if fmi3 else given

    def decoded(self) -> list[Any]:
        """What the FMU has written to the buffer."""
        values: list[Any] = self.buffer[:]
        if self.kind.function == "String":
            return [(value or b"").decode("utf-8", "replace") for value in values]
        return values

    def encode(self, values: Sequence[Any]) -> None:
        """Put values into the buffer; ValueError, with the name of the variable, where one is outside the type."""
        for k, (name, value) in enumerate(zip(self.names, values, strict=True)):
            try:
                self.buffer[k] = self.kind.encoded(value)
            except (ValueError, OverflowError) as error:
                raise ValueError(f"{name}: {error}") from None


def element_names(variable: Any) -> list[str]:
    """Names of a variable's scalars: itself, or `name[1,2]` for each element of an array."""
    if not variable.shape:
        return [variable.name]
    indices = itertools.product(*(range(1, n + 1) for n in variable.shape))
    return [f"{variable.name}[{','.join(map(str, index))}]" for index in indices]
