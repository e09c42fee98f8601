"""Drive (replay of a log through an FMU) in a worker process: the worker's side and the caller's side."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from cosim.blocks.compiling import with_permission
from cosim.blocks.shared_code import claim
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.core.scratch import ScratchFolder, scratch
from cosim.fmi.state import Memory, Own
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Remote, Worker
from cosim.isolation.rows import Rows, allocate, mapped_table, read_table
from cosim.isolation.watch import Watch, fmi_calls
from cosim.logs.log import Log
from cosim.residuals.drive import PLANT, Drive, StoppedReplay

MODULES = ("cosim.residuals.remote_drive", "fmpy.fmi2", "fmpy.logging")


def hosted_drive(log: Log, fmu: Path, interpolated: frozenset[str], table: Path) -> Drive:
    """Return a drive in the worker that writes its rows into a file; its FMU is loaded at the first run."""
    claim(fmu)
    drive, progress = Drive(log, fmu, interpolated=interpolated), here.progress
    here.share_log(drive.block)
    drive._new_rows = lambda rows, columns: Rows(
        mapped_table(table, rows, columns), made=progress.made, doing=progress.doing
    )
    return drive


def _there(method: str) -> Any:
    """Return a method that is called in the worker."""
    return lambda self, *arguments: self._ask(method, *arguments)


class DriveApart(Drive):
    """Drive whose FMU runs in a worker process, and is reloaded there after a crash."""

    initial, own, state = map(_there, ("initial", "own", "state"))

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
        self._worker, self._limits, self._full = worker, limits or Limits(), log  # base of copies with other readings
        self._most = max(len(self._steps(0, log.rows - 1).times), log.rows) + 2  # largest number of rows of a run

    def __enter__(self) -> Self:
        self._held: ScratchFolder = scratch("cosim-replay-rows-")
        self._file = self._held.path / "rows"
        between = frozenset(name for name, ramps in zip(self.inputs, self._ramps, strict=True) if ramps)
        drive = self._full, self.fmu.resolve(), between, self._file
        self._remote = Remote(self._worker, with_permission, self.block.compiles, hosted_drive, *drive)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._remote.free("__exit__", None, None, None, watch=self._watch(()))
        finally:
            self._held.remove()

    def run_and_keep(
        self,
        first: int,
        last: int,
        start: Mapping[str, Any],
        rows: Container[int],
        memory: Memory | None = None,
    ) -> tuple[Array, dict[int, Own]]:
        """Run the FMU as `Drive.run_and_keep`; the finished rows of an interrupted run are in `left`."""
        steps = self._steps(first, last)
        self.left = None
        try:
            answer: tuple[Array, dict[int, Own]]
            answer = self._ask("run_and_keep", first, last, start, rows, memory, times=steps.reached)
        except StoppedReplay:
            raise
        except BaseException as error:
            finished = read_table(self._file, self._worker.progress.made[0], len(self.outputs))
            done = self._at_rows(finished, steps.reached, first, last)
            if isinstance(error, SimulationError):
                raise StoppedReplay(error, done) from None
            if last == self._full.rows - 1:
                self.left = done
            raise
        self._count(steps)
        return answer

    def _ask(self, method: str, *arguments: Any, times: Any = ()) -> Any:
        """Call a method in the worker; `times` are the times of the rows that the call computes."""
        if not self._remote.is_made:
            self._worker.start()
            self._worker.take_along(self._file.parent)
            allocate(self._file, 8 * self._most * len(self.outputs))
            self._remote.make(self._watch(()))
        return self._remote.call("answer", method, self.given, *arguments, watch=self._watch(times))

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
