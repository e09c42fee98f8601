"""A kernel's arrays, in and out, whatever it is compiled from."""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.refine.generate import Generated

Array = NDArray[np.float64]
SETTLE = 0.8  # [s] until the lags have forgotten their unknown start; so long no state is believed to be known better


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


class ArrayKernel:
    """What kernels share: room for results. An array without rows stands for what is not given or not wanted."""

    generated: Generated

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log; q is per stochastic state, r per output. A run that diverges gives infinite errors."""
        rows, ny = data.y.shape
        kept = rows if states else 0
        errors, variances = np.empty((rows, ny)), np.empty((rows, ny))
        filtered = np.full((kept, len(self.generated.states)), np.nan)
        memory = np.full((kept, self.generated.memory), np.nan)
        vectors = [_plain(v) for v in (p, x0, P0, q, r)]
        done = self._filter(data, _plain(data.u), _plain(data.y), vectors, [errors, variances, filtered, memory])
        if done < rows:
            errors[done:], variances[done:] = np.inf, 1.0
        return Filtered(errors, variances, filtered, memory)

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        """Run on the commands of a log from row `first`, `kicks` (rows, states) added to the state at each row."""
        rows, nx = len(data.u), len(self.generated.states)
        outputs, states = np.full((rows, len(self.generated.outputs)), np.nan), np.full((rows, nx), np.nan)
        memories = np.zeros((rows, self.generated.memory))
        vectors = [_plain(v) for v in (p, x0, memory, np.empty((0, nx)) if kicks is None else kicks)]
        self._simulate(data, _plain(data.u), first, vectors, [outputs, states, memories])
        return Simulated(outputs, states, memories)

    def _filter(self, data: Data, u: Array, y: Array, given: Sequence[Array], room: Sequence[Array]) -> int:
        """Fill errors, variances, states and memory from p, x0, P0, q and r; the number of rows done."""
        raise NotImplementedError

    def _simulate(self, data: Data, u: Array, first: int, given: Sequence[Array], room: Sequence[Array]) -> None:
        """Fill outputs, states and memory from p, x0, memory and kicks."""
        raise NotImplementedError


def _plain(a: Array) -> Array:
    """Doubles side by side that may be written, which is what compiled code was promised."""
    return np.require(a, np.float64, ["C", "W"])


def constants(g: Generated) -> Mapping[str, float | tuple[int, ...]]:
    """What the text of a filter takes as known, by name."""
    return {
        "NX": len(g.states),
        "NU": g.inputs,
        "NY": len(g.outputs),
        "NS": len(g.stochastic),
        "NM": g.memory,
        "DELAY": g.delay,
        "STOCHASTIC": g.stochastic,
        "SETTLE": SETTLE,
    }


def cached(source: str, suffix: str) -> Path:
    """Where what is made of a source is kept: in the user's cache, or, where none can be written, as long as we run."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cosim-hovercraft" / "kernels"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    name = hashlib.sha256(source.encode()).hexdigest()[:32]
    return (folder if writable else Path(_temporary().name)) / f"{name}{suffix}"


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    """A folder of this process alone."""
    return tempfile.TemporaryDirectory(prefix="cosim-kernels-", ignore_cleanup_errors=True)
