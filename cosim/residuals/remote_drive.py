"""Drive (replay of a log through an FMU) in a worker process: the worker's side and the caller's side."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.base.scratch import ScratchFolder, scratch
from cosim.blocks.compiling import with_permission
from cosim.blocks.shared_code import claim
from cosim.fmi.state import Memory, Own
from cosim.isolation import worker as own_process
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER, Rows, allocate, mapped_table, read_table
from cosim.isolation.watch import Watch, fmi_calls
from cosim.logs.log import Log
from cosim.residuals.drive import PLANT, Drive, StoppedReplay

MODULES = ("cosim.residuals.remote_drive", "fmpy.fmi2", "fmpy.logging")

# -- in the worker ----------------------------------------------------------------------------

_drives: dict[int, Drive] = {}


@dataclass(frozen=True)
class Loaded:
    """Description of a `Drive` (replay of a log through an FMU) for a worker.

    Attributes:
        number: Number of the drive, unique in the caller.
        interpolated, given: As for `Drive`.
        table: File for the rows of a run.
    """

    number: int
    log: Log
    fmu: Path
    interpolated: frozenset[str]
    given: Mapping[str, Any]
    table: Path


def load(loaded: Loaded) -> None:
    """Create a drive in the worker; its FMU is loaded at the first run."""
    claim(loaded.fmu)
    drive = Drive(loaded.log, loaded.fmu, interpolated=loaded.interpolated, given=loaded.given)
    own_process.share_log(drive.block)
    drive._new_rows = partial(_map_rows, loaded.table)
    _drives[loaded.number] = drive


def _map_rows(path: Path, rows: int, columns: int) -> Rows:
    return Rows(mapped_table(path, rows, columns), made=own_process.progress.made, doing=own_process.progress.doing)


def ask(number: int, method: str, *arguments: Any) -> Any:
    """Call a method of a drive in the worker process, by the drive's number."""
    own_process.progress.doing[0] = OTHER
    return getattr(_drives[number], method)(*arguments)


def unload(number: int) -> None:
    """Free the FMU of a drive; a stop may come before it is loaded."""
    own_process.progress.doing[0] = OTHER
    if (drive := _drives.pop(number, None)) is not None:
        drive.block.close()


# -- in the caller ----------------------------------------------------------------------------


class DriveApart(Drive):
    """Drive whose FMU runs in a worker process, and is reloaded there after a crash."""

    _numbers = itertools.count()

    def __init__(
        self,
        worker: Worker,
        log: Log,
        fmu: Path,
        progress: Callable[[int], None] | None = None,
        *,
        interpolated: Container[str] = (),
        limits: Limits | None = None,
        given: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        super().__init__(log, fmu, progress, interpolated, given)
        self._worker, self._limits, self._interpolated = worker, limits or Limits(), interpolated
        self._number, self._process = next(self._numbers), 0
        self._full = log  # base of copies with other measurements
        self._most = max(len(self._steps(0, log.rows - 1).times), log.rows) + 2  # largest number of rows of a run
        self._held: ScratchFolder | None = None

    def __enter__(self) -> Self:
        self._held = scratch("cosim-replay-rows-")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None and self._process and self._process == self._worker.starts:
                self._worker.call(unload, self._number, watch=self._watch(()))
        finally:
            if self._held is not None:
                self._held.remove()

    def initial(self, start: Mapping[str, Any], row: int) -> dict[str, float]:
        """Return the initial outputs, as `Drive.initial`."""
        self._check_start(start)
        answer: dict[str, float] = self._ask("initial", start, row)
        return answer

    def own(self, start: Mapping[str, Any]) -> Own:
        """Return the initial state, as `Drive.own`."""
        answer: Own = self._ask("own", start)
        return answer

    def state(self) -> Own:
        """Return the final state, as `Drive.state`."""
        answer: Own = self._ask("state")
        return answer

    def run_and_keep(
        self, first: int, last: int, start: Mapping[str, Any], rows: Container[int]
    ) -> tuple[Array, dict[int, Own]]:
        """Run and return outputs and states, as `Drive.run_and_keep`."""
        answer: tuple[Array, dict[int, Own]] = self._run("run_and_keep", first, last, start, rows)
        return answer

    def run(
        self,
        first: int,
        last: int,
        start: Mapping[str, Any],
        memory: Memory | None = None,
        visit: Callable[[int], None] | None = None,
    ) -> Array:
        """Run and return outputs, as `Drive.run`, without `visit`."""
        assert visit is None
        answer: Array = self._run("run", first, last, start, memory)
        return answer

    # -- internals ----------------------------------------------------------------------------

    def _run(self, method: str, first: int, last: int, *arguments: Any) -> Any:
        steps = self._steps(first, last)
        self.left = None
        try:
            answer = self._ask(method, first, last, *arguments, times=steps.reached)
        except StoppedReplay:
            raise
        except SimulationError as error:
            table = self._read_finished_rows()
            raise StoppedReplay(error, self._at_rows(table, steps.reached, first, last)) from None
        except BaseException:
            table = self._read_finished_rows()
            if last == self._full.rows - 1:
                self.left = self._at_rows(table, steps.reached, first, last)
            raise
        self._count(steps)
        return answer

    def _ask(self, method: str, *arguments: Any, times: Any = ()) -> Any:
        """Call a method in the worker; `times` are the times of the rows that the call computes."""
        self._worker.start()
        if self._process != self._worker.starts:
            self._load()
        return self._worker.call(ask, self._number, method, *arguments, watch=self._watch(times))

    @property
    def _file(self) -> Path:
        assert self._held is not None, "a drive apart is a context"
        return self._held.path / "rows"

    def _load(self) -> None:
        self._worker.take_along(self._file.parent)
        allocate(self._file, 8 * self._most * len(self.outputs))
        between = frozenset(name for name in self.inputs if name in self._interpolated)
        loaded = Loaded(self._number, self._full, self.fmu.resolve(), between, dict(self.given), self._file)
        self._worker.call(with_permission, self.block.compiles, load, loaded, watch=self._watch(()))
        self._process = self._worker.starts

    def _watch(self, times: Any) -> Watch:
        begin = float(self.log.time[0])
        driven, progress = self._driven[0], self.progress
        return Watch(
            [PLANT],
            [fmi_calls(self.description)],
            lambda made, call: times[min(max(0, made - 1), len(times) - 1)] if times else begin,
            self._limits,
            8 * len(self.outputs),
            self._worker.spent,
            None if progress is None else lambda made: progress(driven + made),
        )

    def _read_finished_rows(self) -> Array:
        """Return the rows finished before the worker ended."""
        return read_table(self._file, self._worker.progress.made[0], len(self.outputs))
