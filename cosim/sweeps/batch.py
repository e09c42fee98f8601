"""Many runs of a system at once, stepped as arrays with a column per run.

The loop equals that of `cosim.master.master`: values are exchanged during initialization until they settle; then each
stage pulls inputs, steps and is read. Steps are counted, and runs do not influence each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.blocks.faults import samples_of, stream
from cosim.master.initialization import EXACT_SWEEPS
from cosim.sweeps.c_lanes import WIDTH
from cosim.sweeps.twins import Twin, TwinMaker, kind_of, merge_values
from cosim.system.system import System
from cosim.system.wiring import Transfer

Starts = Mapping[str, Mapping[str, Any]]  # component → variable → value
MAX_MEMORY = 1 << 28  # rows and noise in memory at once [bytes]


def kinds_of(system: System) -> dict[str, TwinMaker] | str:
    """Return component → kind of its twin (many runs at once on arrays), or the reason why the sweep needs FMUs."""
    obstacles = {
        "events change parameters while it runs": system.events,
        "signals are no doubles, or a component has a process of its own": system.apart or system.beside,
        "components have steps of their own": any(stage.every != 1 for stage in system.stages),
        "components form an algebraic loop": system.loops,
        "communication steps are controlled, or inputs follow polynomials": system.control or any(system.courses),
        "faults are injected, or enumerations connected": any(
            t.faults or t.items is not None or t.of for t in _transfers(system)
        ),
    }
    for reason, applies in obstacles.items():
        if applies:
            return reason
    kinds = {stage.component.name: kind_of(stage.component) for stage in system.stages}
    if missing := [name for name, kind in kinds.items() if kind is None]:
        return f"{', '.join(missing)}: no equations of an FMU of this kind are available"
    return {name: kind for name, kind in kinds.items() if kind is not None}


def obstacle_to_arrays(system: System) -> str:
    """Return why the runs cannot be computed on arrays and need the FMUs; "" if arrays suffice."""
    kinds = kinds_of(system)
    return kinds if isinstance(kinds, str) else ""


def max_runs_at_once(system: System, steps: int, signals: int) -> int:
    """Return the number of runs that fit into memory at once, a multiple of the width of compiled code."""
    noisy = sum(t.noise is not None for t in _transfers(system))
    return max(WIDTH, min(1024, MAX_MEMORY // (8 * (steps + 1) * (signals + noisy + 1)) // WIDTH * WIDTH))


@dataclass(frozen=True)
class Batch:
    """Common settings of all runs: system, twins, steps and their length [s].

    Attributes:
        compiled: Whether equations are compiled if possible.
    """

    system: System
    kinds: Mapping[str, TwinMaker]
    steps: int
    h: float
    compiled: bool = True

    def run(self, starts: Sequence[Starts], seeds: Sequence[int], columns: Sequence[int]) -> Array:
        """Return the rows of signals, shape (steps + 1, columns, runs).

        Failed runs contain NaN or infinity.

        Args:
            starts: All start values by component, for each run.
            columns: Places of the signals.
        """
        table = np.empty((self.steps + 1, len(columns), len(starts)))
        groups: dict[Any, list[int]] = {}
        for k, start in enumerate(starts):
            pattern = tuple(kind.pattern(start.get(name, {})) for name, kind in self.kinds.items())
            groups.setdefault(pattern, []).append(k)
        with np.errstate(all="ignore"):
            for members in groups.values():
                part = _PartOfBatch(self, [starts[k] for k in members], [seeds[k] for k in members])
                if len(groups) == 1:
                    return part.rows(columns)
                table[:, :, members] = part.rows(columns)
        return table


class _PartOfBatch:
    """Runs with the same active effects."""

    def __init__(self, batch: Batch, starts: Sequence[Starts], seeds: Sequence[int]) -> None:
        count = len(starts)
        padded = -(-count // WIDTH) * WIDTH
        starts = [*starts, *[starts[-1]] * (padded - count)]
        self.system, self.steps, self.h, self.count = batch.system, batch.steps, batch.h, count
        system = batch.system
        self.row = np.zeros((len(system.columns), padded))
        self.twins: list[tuple[str, Twin]] = []
        owners = [column.partition(".")[0] for column in system.columns]
        for stage in system.stages:
            c = stage.component
            values = merge_values([start.get(c.name, {}) for start in starts])
            twin = batch.kinds[c.name].make(values, padded, compiled=batch.compiled)
            at = owners.index(c.name) if c.name in owners else 0
            split, end = at + len(c.inputs), at + len(c.inputs) + len(c.outputs)
            twin.begin(self.row[at:split], self.row[split:end], system.start)
            self.twins.append((c.name, twin))
        self.samples = {t.name: self._noise(t, seeds) for t in _transfers(system) if t.noise is not None}

    def _noise(self, transfer: Transfer, seeds: Sequence[int]) -> Array:
        """Return noise samples, shape (steps + 1, runs). Each run gets the same samples as when run alone."""
        samples = np.empty((self.row.shape[1], self.steps + 1))
        assert transfer.noise is not None
        variance, bias = transfer.noise.variance, transfer.noise.bias
        for k, seed in enumerate(seeds):
            samples[k] = samples_of(stream(seed, transfer.name), variance, bias, self.steps + 1)
        samples[self.count :] = samples[self.count - 1]
        return np.ascontiguousarray(samples.T)

    def rows(self, columns: Sequence[int]) -> Array:
        """Step all runs and return rows, shape (steps + 1, columns, runs)."""
        table = np.empty((self.steps + 1, len(columns), self.count))
        self._settle({s.component.name: s.transfers for s in self.system.stages})
        table[0] = self.row[columns, : self.count]
        h, begin = self.h, self.system.start
        next_t = begin
        for k in range(1, self.steps + 1):
            t, next_t = next_t, begin + k * h
            for stage, (_, twin) in zip(self.system.stages, self.twins, strict=True):
                self._transfer(stage.pulls, k)
                twin.advance(t, h if stage.component.nominal_step else next_t - t)
                if stage.late:
                    self._transfer(stage.late, k)
                    twin.settle()
            self._transfer(self.system.held, k)
            table[k] = self.row[columns, : self.count]
        return table

    def _settle(self, pulls: Mapping[str, Sequence[Transfer]]) -> None:
        for _ in range(EXACT_SWEEPS * (len(self.twins) + 1)):
            before = self.row.copy()
            for name, twin in self.twins:
                self._transfer(pulls[name], 0)
                twin.settle()
            self._transfer(self.system.held, 0)
            if np.array_equal(before, self.row, equal_nan=True):
                return

    def _transfer(self, transfers: Sequence[Transfer], k: int) -> None:
        row = self.row
        for t in transfers:
            target = row[t.target]
            if t.factor != 1.0 or t.offset != 0.0:
                np.multiply(row[t.source], t.factor, out=target)
                target += t.offset
            else:
                target[:] = row[t.source]
            if t.noise is not None:
                target += self.samples[t.name][k]


def _transfers(system: System) -> list[Transfer]:
    return [*system.held, *(t for stage in system.stages for t in stage.transfers)]
