"""Filter in C, compiled once for each model and its measured outputs; the library is cached by its source."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import cosim.fmi.native
from cosim.core.arrays import Array
from cosim.estimation.kernel.generate import Generated
from cosim.estimation.kernel.kernel import MEMORY, Data, Filtered, Simulated, no_filtered, no_simulated
from cosim.fmi.native.compiler import load_library

NATIVE = Path(cosim.fmi.native.__file__).parent
FOLDER = Path(__file__).parent


class _Log(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("rows", "substeps", "settle")),
        *((name, ctypes.c_double) for name in ("step", "start")),
        *((name, ctypes.c_void_p) for name in ("u", "y", "ramps", "late", "lags")),
    )
    arrays: list[Array]  # to which it has addresses


class CompiledKernel:
    """Kernel in C; an array without rows stands for no array.

    Raises:
        NoCompiler: No C compiler exists.
        CompilerFailed: The compiler reports an error.
    """

    def __init__(self, generated: Generated) -> None:
        self.layout = generated.layout
        self._library = load_library(_source(generated), NATIVE / "rk4.h", NATIVE / "stiff.h")

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel.run`."""
        made = no_filtered(self.layout, data, states=states)
        inputs = [_contiguous(v) for v in (p, x0, P0, q, np.broadcast_to(r, data.y.shape))]
        log, addresses = self._log(data, data.y, data.late, data.lags), map(_address, (*inputs, *vars(made).values()))
        done = self._library.filter(ctypes.byref(log), *addresses)
        made.errors[done:], made.variances[done:] = np.inf, 1.0
        return made

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, first: int = 0
    ) -> Simulated:
        """Simulate with the commands of a log, as `Kernel.simulate`."""
        self._use(p, data, x0)
        made = no_simulated(self.layout, data)
        inputs = [_contiguous(v) for v in (p, x0, memory, np.empty(0) if kicks is None else kicks)]
        log, addresses = self._log(data), map(_address, (*inputs, *vars(made).values()))
        self._library.simulate(ctypes.byref(log), first, *addresses)
        return made

    def simulate_from(
        self, data: Data, p: Array, points: tuple[Sequence[int], Any, Any], length: int
    ) -> list[Simulated]:
        """Simulate rows of a log from each of some rows, as `Problem.simulate_from`."""
        rows, states, memory = np.array(points[0], np.int32), _contiguous(points[1]), _contiguous(points[2])
        sizes = len(self.layout.outputs), len(self.layout.states), self.layout.memory
        made = [np.full((len(rows), length + 1, size), np.nan) for size in sizes]
        if len(rows):
            self._use(p, data, states[0])
        p = _contiguous(p)
        addresses = map(_address, (p, states, memory, *made))
        self._library.simulate_from(ctypes.byref(self._log(data)), len(rows), _address(rows), length, *addresses)
        ends = np.minimum(length + 1, len(data.u) - rows).tolist()
        return [Simulated(*(each[:end] for each in run)) for end, *run in zip(ends, *made, strict=True)]

    def _use(self, p: Array, data: Data, x0: Array) -> None:
        """Prepare the functions of the model, which are those of a library in a derived class."""

    def _log(self, data: Data, y: Array | None = None, late: Array | None = None, lags: Array | None = None) -> _Log:
        """Return a log for C, by default without readings; it keeps its arrays."""
        u, *past = (_contiguous(np.empty(0) if a is None else a) for a in (data.u, y, late, lags))
        ramps: Any = np.array([name in data.interpolated for name in self.layout.inputs], np.int32)
        arrays = [u, past[0], ramps, *past[1:]]
        times = len(data.u), data.substeps, data.settle, data.step, data.start
        log = _Log(*times, *map(_address, arrays))
        log.arrays = arrays
        return log


def _contiguous(a: Array) -> Array:
    """Return an array as contiguous doubles, as C needs them."""
    return np.require(a, np.float64, ["C"])


def _address(a: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(a.ctypes.data if a.size else None)


def _source(generated: Generated) -> str:
    """Return the C source of the filter: sizes, generated functions and hand-written code."""
    layout, before, stepped = generated.layout, list[Path](), generated.layout.is_free_run
    groups = {"NX": layout.states, "NU": layout.inputs, "NY": layout.outputs, "NS": layout.stochastic}
    sizes: dict[str, Any] = {name: len(group) for name, group in groups.items()}
    sizes |= {"NM": layout.memory, "DELAY": f"({layout.delay})", "STIFF": int(generated.stiff), "STEPPED": int(stepped)}
    places: dict[str, Sequence[int]] = {"STOCHASTIC": layout.stochastic}
    if generated.library is not None:
        sizes |= zip(("NB", "NL"), generated.library, strict=True)
        before = [FOLDER / "library_calls.c", FOLDER / ("stepped_library.c" if stepped else "library.c")]
    if stepped:
        sizes |= {"UNNAMED": int(generated.unnamed), "LASTING": layout.parameters.index(MEMORY)}
        sizes["POSITIONS"] = len(layout.positions)
        places["READ_PLACES"] = layout.positions
        places["RUN_PLACES"] = [layout.states.index(layout.outputs[k]) for k in layout.positions]
    sizes |= {name: f"{{{', '.join(map(str, each or (0,)))}}}" for name, each in places.items()}
    head = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    after = NATIVE / "step.c", FOLDER / "lags.c", FOLDER / ("free_run.c" if stepped else "filter.c")
    first, last = ([path.read_text(encoding="utf-8") for path in paths] for paths in (before, after))
    return "\n".join(("#include <math.h>", head, *first, generated.source, *last))
