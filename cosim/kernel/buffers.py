"""A kernel made of compiled functions: room for their results, whatever they are compiled from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.base.arrays import Array
from cosim.kernel.kernel import Data, Filtered, Layout, Simulated


class ArrayKernel:
    """What compiled kernels share. An array without rows stands for what is not given or not wanted."""

    layout: Layout

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log, as `Kernel` says."""
        rows, ny = data.y.shape
        kept = rows if states else 0
        errors, variances = np.empty((rows, ny)), np.empty((rows, ny))
        filtered = np.full((kept, len(self.layout.states)), np.nan)
        memory = np.full((kept, self.layout.memory), np.nan)
        vectors = [_plain(v) for v in (p, x0, P0, q, np.broadcast_to(r, data.y.shape))]
        done = self._filter(data, _plain(data.u), _plain(data.y), vectors, [errors, variances, filtered, memory])
        if done < rows:
            errors[done:], variances[done:] = np.inf, 1.0
        return Filtered(errors, variances, filtered, memory)

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        """Run on the commands of a log, as `Kernel` says."""
        rows, nx = len(data.u), len(self.layout.states)
        outputs, states = np.full((rows, len(self.layout.outputs)), np.nan), np.full((rows, nx), np.nan)
        memories = np.zeros((rows, self.layout.memory))
        vectors = [_plain(v) for v in (p, x0, memory, np.empty((0, nx)) if kicks is None else kicks)]
        self._simulate(data, _plain(data.u), first, vectors, [outputs, states, memories])
        return Simulated(outputs, states, memories)

    def _ramps(self, data: Data) -> Array:
        """Which inputs are interpolated, as flags of C."""
        return np.array([name in data.interpolated for name in self.layout.inputs], np.int32)

    def _late(self, data: Data) -> Array:
        """Part of a row by which each reading is older than its row; without rows where none is."""
        return _plain(np.empty((0, len(self.layout.outputs))) if data.late is None else data.late)

    def _filter(self, data: Data, u: Array, y: Array, given: Sequence[Array], room: Sequence[Array]) -> int:
        """Fill errors, variances, states and memory from p, x0, P0, q and r; the number of rows done."""
        raise NotImplementedError

    def _simulate(self, data: Data, u: Array, first: int, given: Sequence[Array], room: Sequence[Array]) -> None:
        """Fill outputs, states and memory from p, x0, memory and kicks."""
        raise NotImplementedError


def _plain(a: Array) -> Array:
    """Doubles side by side that may be written, which is what compiled code was promised."""
    return np.require(a, np.float64, ["C", "W"])


def constants(layout: Layout) -> Mapping[str, float | tuple[int, ...]]:
    """What the text of a filter takes as known, by name."""
    return {
        "NX": len(layout.states),
        "NU": len(layout.inputs),
        "NY": len(layout.outputs),
        "NS": len(layout.stochastic),
        "NM": layout.memory,
        "DELAY": layout.delay,
        "STOCHASTIC": layout.stochastic,
    }
