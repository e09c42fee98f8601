"""The compiled filter: built once for a model and the outputs a log holds, cached by content."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.refine.generate import Generated

Array = NDArray[np.float64]
SETTLE, BOOST = 0.5, 1e3  # [s] while the lags forget their unknown start, process noise is this much larger


class _Log(ctypes.Structure):
    _fields_ = (
        ("rows", ctypes.c_int),
        ("substeps", ctypes.c_int),
        ("step", ctypes.c_double),
        ("start", ctypes.c_double),
        ("u", ctypes.c_void_p),
        ("y", ctypes.c_void_p),
    )


@dataclass(frozen=True)
class Data:
    """What the filter sees of a log: u (rows, inputs), y (rows, outputs) with NaN where missing.

    substeps: RK4 steps from row to row
    """

    step: float
    start: float
    u: Array
    y: Array
    substeps: int


@dataclass(frozen=True)
class Filtered:
    """errors and variances (rows, outputs) of each measurement before it is taken; states and memory after."""

    errors: Array
    variances: Array
    states: Array
    memory: Array


@dataclass(frozen=True)
class Simulated:
    """outputs (rows, outputs) free of noise, states and memory (rows, …); NaN before the first row."""

    outputs: Array
    states: Array
    memory: Array


def compiler() -> str | None:
    """The C compiler of this machine, if there is one."""
    return next((c for c in (os.environ.get("CC"), "cc", "gcc", "clang") if c and shutil.which(c)), None)


class CompiledKernel:
    """The filter in C."""

    def __init__(self, generated: Generated) -> None:
        self.generated = generated
        self._library = ctypes.CDLL(str(_compiled(_source(generated))))
        self._filter = self._library.filter
        self._filter.argtypes = [ctypes.POINTER(_Log), *[ctypes.c_void_p] * 9]

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log; q is per stochastic state, r per output. A run that diverges gives infinite errors."""
        rows, ny = data.y.shape
        nx, nm = len(self.generated.states), self.generated.memory
        errors, variances = np.empty((rows, ny)), np.empty((rows, ny))
        filtered = np.empty((rows, nx)) if states else np.empty((0, nx))
        memory = np.empty((rows, nm)) if states else np.empty((0, nm))
        u, y = np.ascontiguousarray(data.u), np.ascontiguousarray(data.y)
        log = _Log(rows, data.substeps, data.step, data.start, u.ctypes.data, y.ctypes.data)
        vectors = [np.ascontiguousarray(v, dtype=float) for v in (p, x0, P0, q, r)]
        done = self._filter(
            ctypes.byref(log),
            *(v.ctypes.data for v in vectors),
            errors.ctypes.data,
            variances.ctypes.data,
            filtered.ctypes.data if states else None,
            memory.ctypes.data if states and nm else None,
        )
        if done < rows:
            errors[done:], variances[done:] = np.inf, 1.0
        return Filtered(errors, variances, filtered, memory)

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        """Run on the commands of a log from row `first`, `kicks` (rows, states) added to the state at each row."""
        rows, nx, nm = len(data.u), len(self.generated.states), self.generated.memory
        outputs = np.full((rows, len(self.generated.outputs)), np.nan)
        states, memories = np.full((rows, nx), np.nan), np.zeros((rows, max(1, nm)))
        u = np.ascontiguousarray(data.u)
        log = _Log(rows, data.substeps, data.step, data.start, u.ctypes.data, None)
        vectors = [np.ascontiguousarray(v, dtype=float) for v in (p, x0, memory)]
        kicked = None if kicks is None else np.ascontiguousarray(kicks)
        self._library.simulate(
            ctypes.byref(log),
            ctypes.c_int(first),
            *(ctypes.c_void_p(v.ctypes.data) for v in vectors),
            ctypes.c_void_p(None if kicked is None else kicked.ctypes.data),
            ctypes.c_void_p(outputs.ctypes.data),
            ctypes.c_void_p(states.ctypes.data),
            ctypes.c_void_p(memories.ctypes.data if nm else None),
        )
        return Simulated(outputs, states, memories[:, :nm])


def _source(g: Generated) -> str:
    """The whole C file."""
    constants: Mapping[str, object] = {
        "NX": len(g.states),
        "NU": g.inputs,
        "NY": len(g.outputs),
        "NS": len(g.stochastic),
        "NM": g.memory,
        "DELAY": f"({g.delay})",
        "STOCHASTIC": "{" + ", ".join(map(str, g.stochastic)) + "}",
        "SETTLE": SETTLE,
        "BOOST": BOOST,
    }
    head = "\n".join(f"#define {name} {value}" for name, value in constants.items())
    body = (Path(__file__).parent / "filter.c").read_text(encoding="utf-8")
    return f"#include <math.h>\n{head}\n{g.source}\n{body}"


def _compiled(source: str) -> Path:
    """The shared library of a source, from the cache or compiled now."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cosim-hovercraft" / "kernels"
    target = root / f"{hashlib.sha256(source.encode()).hexdigest()[:32]}.so"
    if target.exists():
        return target
    cc = compiler()
    if cc is None:
        raise FileNotFoundError("no C compiler")
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root) as folder:
        file, library = Path(folder) / "filter.c", Path(folder) / "filter.so"
        file.write_text(source, encoding="utf-8")
        options: Sequence[str] = (  # errno of sin and pow is not looked at
            "-O3",
            "-fno-math-errno",
            "-shared",
            "-fPIC",
            "-std=c99",
            "-o",
            str(library),
            str(file),
            "-lm",
        )
        subprocess.run([cc, *options], check=True, capture_output=True, timeout=120)
        library.replace(target)
    return target
