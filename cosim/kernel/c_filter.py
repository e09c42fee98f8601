"""The filter in C: built once for a model and the outputs a log holds, cached by content."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

import cosim.fmi.native
from cosim.base.arrays import Array
from cosim.fmi.native.compiler import loaded
from cosim.kernel.buffers import ArrayKernel, constants
from cosim.kernel.generate import Generated
from cosim.kernel.kernel import Data

STEP = Path(cosim.fmi.native.__file__).with_name("step.c")
FILTER = Path(__file__).with_name("filter.c")


class _Log(ctypes.Structure):
    _fields_ = (
        ("rows", ctypes.c_int),
        ("substeps", ctypes.c_int),
        ("settle", ctypes.c_int),
        ("step", ctypes.c_double),
        ("start", ctypes.c_double),
        ("u", ctypes.c_void_p),
        ("y", ctypes.c_void_p),
        ("ramps", ctypes.c_void_p),
        ("late", ctypes.c_void_p),
    )


class CompiledKernel(ArrayKernel):
    """The filter in C. Raises OSError or subprocess.SubprocessError where the compiler does not do its work."""

    def __init__(self, generated: Generated) -> None:
        self.layout = generated.layout
        self._library = loaded(_source(generated))
        self._library.filter.argtypes = [ctypes.POINTER(_Log), *[ctypes.c_void_p] * 9]
        self._library.simulate.argtypes = [ctypes.POINTER(_Log), ctypes.c_int, *[ctypes.c_void_p] * 7]

    def _filter(self, data: Data, u: Array, y: Array, given: Sequence[Array], room: Sequence[Array]) -> int:
        ramps = self._ramps(data)
        times = (len(u), data.substeps, data.settle, data.step, data.start)
        late = self._late(data)
        log = _Log(*times, u.ctypes.data, y.ctypes.data, ramps.ctypes.data, _address(late))
        return int(self._library.filter(ctypes.byref(log), *map(_address, (*given, *room))))

    def _simulate(self, data: Data, u: Array, first: int, given: Sequence[Array], room: Sequence[Array]) -> None:
        ramps = self._ramps(data)
        times = (len(u), data.substeps, data.settle, data.step, data.start)
        log = _Log(*times, u.ctypes.data, None, ramps.ctypes.data, None)
        self._library.simulate(ctypes.byref(log), first, *map(_address, (*given, *room)))


def _address(a: Array) -> int | None:
    return a.ctypes.data if a.size else None


def _source(generated: Generated) -> str:
    """The whole C file."""

    def literal(value: float | tuple[int, ...]) -> str:
        return "{" + ", ".join(map(str, value or (0,))) + "}" if isinstance(value, tuple) else f"({value})"

    head = "\n".join(f"#define {name} {literal(value)}" for name, value in constants(generated.layout).items())
    bodies = (STEP.read_text(encoding="utf-8"), FILTER.read_text(encoding="utf-8"))
    return "\n".join(("#include <math.h>", head, generated.source, *bodies))
