"""Simulation of an FMU with the recorded commands of a log, in this process or in a worker process."""

from __future__ import annotations

import copy
import ctypes
import math
from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np

from cosim.blocks.compiling import with_permission
from cosim.blocks.component import ADVANCE, GET, PUT, Signal
from cosim.blocks.fmu import FmuBlock, RestartableFmu
from cosim.blocks.shared_code import claim
from cosim.core.arrays import Array, Flags, Rows
from cosim.core.errors import Fault, FmuError, InputError, SimulationError, refuse
from cosim.core.scratch import ScratchFolder, scratch
from cosim.core.text import split_assignment
from cosim.core.times import rounding, roundings
from cosim.files.artefact import FMU, LOG
from cosim.files.kinds import check_given
from cosim.files.yaml_file import Document, NotYaml, short
from cosim.fmi.annotations import traits_of
from cosim.fmi.description import read_description, takes_any_step
from cosim.fmi.state import Memory, Own
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Remote, Worker
from cosim.isolation.rows import OTHER, allocate, mapped_table, read_table
from cosim.isolation.rows import Rows as SharedRows
from cosim.isolation.watch import Watch, fmi_calls
from cosim.logs.log import Log, read_log
from cosim.scenario.start_values import NOT_NUMBERS, start_value

PLANT_COMPONENT = "plant"  # component name in results and messages
REPLAY_MODULES = ("cosim.residuals.drive", "fmpy.fmi2", "fmpy.logging")
PROGRESS_EVERY_ROWS = 500
BOOLEAN_TEXTS = {"true": True, "on": True, "1": True, "false": False, "off": False, "0": False}
PRINTED_TIME_FACTOR = 1e3  # times the tolerance of times, for logs whose times are printed
STEPS_PER_ROW = 8  # steps between rows for interpolated inputs, each held at its midpoint


class DriveSteps(NamedTuple):
    """Steps of an FMU between two rows of a log.

    Attributes:
        times, lengths: Start and length of each step [s].
        rows: Row whose command acts in each step.
        reads: True for each step after which the outputs are read.
        reached: Times at which outputs are read [s], including the start.
    """

    times: Array
    lengths: Array
    rows: Rows
    reads: Flags
    reached: Array


def model_signals(fmu: Path) -> tuple[Sequence[Signal], Sequence[Signal]]:
    """Return the real inputs and outputs of an FMU, the signals of its logs."""
    block = FmuBlock(PLANT_COMPONENT, fmu, read_description(fmu), {}, frozenset())
    return block.inputs, block.outputs


def check_files(log: Path, fmu: Path | None) -> None:
    """Check that two paths are a log and an FMU.

    Raises:
        InputError: A file is of another kind, or faults concern both files.
    """
    faults: list[Fault] = []
    for path, kind in ((log, LOG), *([(fmu, FMU)] if fmu else [])):
        try:
            check_given(path, kind)
            if faults:
                read_description(path)
        except InputError as error:
            faults += error.faults
        except FmuError as error:
            faults.append(error.fault(path))
    refuse(faults)


def log_of_fmu(path: Path, fmu: Path, columns: Mapping[str, str] = MappingProxyType({}), *, alone: bool = True) -> Log:
    """Read a log with the inputs and outputs of an FMU.

    Args:
        columns: Name in the log → name in the FMU, if different.
        alone: True if `columns` is for this log only, so that a missing column is a fault.

    Raises:
        InputError: The log has faults, all of which the error names.
        FmuError: Only the FMU has faults.
    """
    check_files(path, fmu)
    return read_log(path, *model_signals(fmu), columns=columns, alone=alone)


class Drive:
    """Replays of a log through an FMU, as a context manager: the FMU is loaded at the first run and freed at the end.

    Args:
        progress: Function that is called with the number of finished steps.
        interpolated: Inputs that are interpolated between rows; other inputs are held.
        given: Start values for all runs, unless a run sets other values.

    Attributes:
        starts: Declared start values of the real inputs.
        frame: Signal names of a planar motion that the FMU declares.
        left: Outputs up to the failure or interruption of a run; None otherwise.
    """

    left: Array | None = None

    def __init__(
        self,
        log: Log,
        fmu: Path,
        progress: Callable[[int], None] | None = None,
        interpolated: Container[str] = (),
        given: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.given = dict(given)
        self.log, self.fmu, self.progress = log, fmu, progress
        self.description = description = read_description(fmu)
        self.traits = traits_of(fmu)  # None for an FMU of another tool
        self.frame = self.traits.planar if self.traits else None
        self.block = RestartableFmu(PLANT_COMPONENT, fmu, description, {}, frozenset(log.inputs))
        self.block.await_inputs(always=True)
        self.inputs = tuple(s.name for s in self.block.inputs if s.name in log.inputs)
        self.outputs = tuple(s.name for s in self.block.outputs)
        self.free_inputs = tuple(s.name for s in self.block.inputs if s.name not in log.inputs)
        texts = {v.name: v.start for v in description.modelVariables}
        real = [s.name for s in self.block.inputs if s.name in self.inputs and not s.is_whole]
        self.starts = {name: float(texts[name]) for name in real if texts.get(name)}
        step = description.defaultExperiment and description.defaultExperiment.stepSize
        self.rate = float(step) if step else None  # default step size [s]
        self.variable_step = takes_any_step(description)
        about = description.coSimulation  # None for an FMU that has only model exchange
        flags = about and about.canGetAndSetFMUstate and about.canSerializeFMUstate
        self.has_readable_state = bool(self.traits and flags and self.variable_step)  # if built by cosim
        self._table = np.column_stack([log.inputs[name] for name in self.inputs]) if self.inputs else np.empty((0, 0))
        self._commands = self._table.tolist()
        self._ramps = np.array([name in interpolated for name in self.inputs], bool)
        self._row = (ctypes.c_double * (len(self.block.inputs) + len(self.outputs)))()
        self.block.bind(self._row, 0)
        self._driven = [0]  # number of steps so far, shared by copies
        self._new_rows: Callable[[int, int], SharedRows] = SharedRows.in_memory

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.block.close()

    @property
    def units(self) -> dict[str, str]:
        """Return the unit of every output."""
        return {s.name: s.unit for s in self.block.outputs}

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return a drive of the same loaded FMU that sets further values in all runs."""
        other = copy.copy(self)
        other.given = {**self.given, **values}
        return other

    def answer(self, method: str, given: Mapping[str, Any], *arguments: Any) -> Any:
        """Return the result of a method, called with other start values, for a drive in another process."""
        self.given = dict(given)
        return getattr(self, method)(*arguments)

    def initial(self, start: Mapping[str, Any], row: int) -> dict[str, float]:
        """Return the outputs after initialization with start values at a row."""
        self._begin(start, row, float(self.log.time[-1]))
        self.block.start()
        self.block.get()
        return dict(zip(self.outputs, self._row[len(self.block.inputs) :], strict=True))

    def own(self, start: Mapping[str, Any]) -> Own:
        """Return the initial state of an FMU built by cosim; check once that this state can be restored."""
        self._begin(start, 0, float(self.log.time[-1]))
        self.block.start()
        self.block.remember({})
        return self.block.own()

    def state(self) -> Own:
        """Return the state of an FMU built by cosim at the end of the last run."""
        return self.block.own()

    def run(self, first: int, last: int, start: Mapping[str, Any], memory: Memory | None = None) -> Array:
        """Simulate the FMU from row `first` to `last` and return the outputs, shape (rows, outputs)."""
        return self.run_and_keep(first, last, start, (), memory)[0]

    def run_and_keep(
        self,
        first: int,
        last: int,
        start: Mapping[str, Any],
        rows: Container[int],
        memory: Memory | None = None,
    ) -> tuple[Array, dict[int, Own]]:
        """Simulate the FMU; return outputs and, for an FMU built by cosim, complete states at the rows in `rows`.

        The command of row k is held from t_k to t_k+1. The outputs of row k are computed with the command of row k.

        Args:
            memory: State at the first row, for an FMU built by cosim; by default the state after initialization.

        Raises:
            SimulationError: The FMU fails; `left` contains the outputs so far.
        """
        steps, states, self.left = self._steps(first, last), dict[int, Own](), None
        written = self._new_rows(len(steps.reached), len(self.outputs))
        table, done, doing = written.table, written.made, written.doing
        here, size = ctypes.addressof(self._row) + 8 * len(self.block.inputs), 8 * len(self.outputs)
        there, block, acting, whole = table.ctypes.data, self.block, first, 0
        reached, width = steps.reached, len(self.inputs)
        close = roundings(reached, PRINTED_TIME_FACTOR * self.log.step)
        following = np.searchsorted(self.log.time, reached + close, side="right") - 1  # row that acts at each reading
        commands = [self._commands[k] for k in following.tolist()] if self._commands else []
        times, lengths, number, reading = (part.tolist() for part in steps[:4])
        each = zip(times, lengths, number, self._puts(steps, first), reading, strict=True)
        try:
            doing[0] = OTHER
            self._begin(start, first, max(float(self.log.time[last]), float(reached[-1])))
            block.start()
            block.get()  # needed by FMI 1.0; some FMUs return correct outputs only after this call
            if memory:
                block.remember(memory)
            ctypes.memmove(there, here, size)
            whole = done[0] = 1
            for made, (t, h, k, command, reads) in enumerate(each, 1):
                if k != acting and k in rows:
                    states[k] = block.own()
                acting = k
                if command is not None:
                    self._row[:width] = command
                    doing[0] = PUT
                    block.put()
                doing[0] = ADVANCE
                block.advance(t, h)
                if reads:
                    doing[0] = PUT
                    if commands and commands[whole] != self._row[:width]:
                        self._row[:width] = commands[whole]
                        block.put()
                    else:
                        block.settle()
                    doing[0] = GET
                    block.get()
                    ctypes.memmove(there + whole * size, here, size)
                    whole = done[0] = whole + 1
                if self.progress is not None and made % PROGRESS_EVERY_ROWS == 0:
                    self.progress(self._driven[0] + made)
        except SimulationError:
            self.left = self._at_rows(table[:whole], reached, first, last)
            raise
        self._count(steps)
        return self._at_rows(table, reached, first, last), states

    # -- internals ----------------------------------------------------------------------------

    def _begin(self, start: Mapping[str, Any], row: int, stop: float) -> None:
        self.block.restart({**self.given, **start}, float(self.log.time[row]), stop)
        if self._commands:
            self._row[: len(self.inputs)] = self._commands[row]
            self.block.put()
        self.block.get()

    def _count(self, steps: DriveSteps) -> None:
        """Count finished steps, and report progress."""
        self._driven[0] += len(steps.times)
        if self.progress is not None:
            self.progress(self._driven[0])

    def _steps(self, first: int, last: int) -> DriveSteps:
        """Return the steps between two rows of the log.

        An FMU with variable step size is stepped from row to row, with several steps over a gap. Another FMU is stepped
        by the log's median step.
        """
        time, step = self.log.time[first : last + 1], self.log.step
        if self.variable_step:
            dt = np.diff(time)
            count = np.maximum(1, np.rint(dt / step)).astype(np.intp) * (STEPS_PER_ROW if self._ramps.any() else 1)
            length = dt / count
            usual = step / STEPS_PER_ROW if self._ramps.any() else step
            is_rounded = np.abs(length - usual) < roundings(
                time[:-1], PRINTED_TIME_FACTOR * usual
            )  # as printed times are
            length[is_rounded] = usual
            number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            times = np.repeat(time[:-1], count) + number * np.repeat(length, count)
            lengths, rows = np.repeat(length, count), np.repeat(np.arange(first, last), count)
            reads = np.diff(rows, append=-1) != 0
        else:
            times = time[0] + step * np.arange(
                max(0, math.ceil((time[-1] - time[0] - rounding(time[-1], PRINTED_TIME_FACTOR * step)) / step))
            )
            lengths, reads = np.full(times.size, step), np.ones(times.size, bool)
            rows = first + np.searchsorted(time, times + roundings(times, PRINTED_TIME_FACTOR * step), side="right") - 1
        return DriveSteps(times, lengths, rows, reads, np.append(time[0], (times + lengths)[reads]))

    def _puts(self, steps: DriveSteps, first: int) -> list[Any]:
        """Return the command to set before each step; None if it is unchanged.

        An interpolated input has its value at the midpoint of the step.
        """
        k, time = steps.rows, self.log.time
        if not self._commands:
            return [None] * k.size
        if not self._ramps.any():
            is_new = np.diff(k, prepend=first) != 0
            return [self._commands[row] if new else None for row, new in zip(k.tolist(), is_new.tolist(), strict=True)]
        here, following = self._table[k], np.minimum(k + 1, time.size - 1)
        lasts = np.where(following > k, time[following] - time[k], 1.0)
        share = (steps.times + 0.5 * steps.lengths - time[k]) / lasts
        moved: list[list[float]] = (
            here + np.where(self._ramps, share[:, None] * (self._table[following] - here), 0.0)
        ).tolist()
        return moved

    def _at_rows(self, table: Array, times: Array, first: int, last: int) -> Array:
        """Return the outputs at the finished rows of the log, interpolated between steps."""
        times, wanted = times[: len(table)], self.log.time[first : last + 1]
        close = coarse_rounding(self.log)
        reached = wanted[wanted <= times.max(initial=-math.inf) + close]
        if times.size == reached.size and np.allclose(times, reached, rtol=0.0, atol=close):
            return table
        return np.column_stack([np.interp(reached, times, column) for column in table.T])


def rows_of(log: Log, first: int, seconds: float) -> int:
    """Return the last row within `seconds` after `first`."""
    return int(np.searchsorted(log.time, log.time[first] + seconds + coarse_rounding(log), side="right")) - 1


def coarse_rounding(log: Log) -> float:
    """Return the difference [s] within which times of a log are equal, which may be printed."""
    return rounding(float(log.time[-1]), PRINTED_TIME_FACTOR * log.step)


def as_columns(table: Array, names: Sequence[str]) -> dict[str, Array]:
    """Return the columns of an array by name."""
    return dict(zip(names, np.ascontiguousarray(table.T), strict=True))


def start_values(fmu: Path, texts: Sequence[str], fault: Callable[[str, str], Fault] | None = None) -> dict[str, Any]:
    """Return start values from texts such as `angle=12 deg`.

    Args:
        fault: Function of (name, message) that returns a fault; by default a fault of the option --start.

    Raises:
        InputError: Texts are invalid; the error names all of them.
    """
    if not texts:
        return {}
    description = read_description(fmu)
    variables = {v.name: v for v in description.modelVariables}
    values: dict[str, Any] = {}
    faults = []
    for text in texts:
        name, _, written = split_assignment(text, variables)
        kind = getattr(variables.get(name), "type", "")
        read: Any = written
        with suppress(NotYaml):
            read = Document(written).data
        if kind in NOT_NUMBERS and not isinstance(read, str):
            read = BOOLEAN_TEXTS.get(written.lower(), written) if kind == "Boolean" else written
        try:
            if not (name and written):
                raise ValueError("write NAME=VALUE, as in gain=0.9")
            values[name] = start_value(description, variables, name, read)
        except ValueError as error:
            message = f"{short(text)}: {error}"
            faults.append(Fault(Path("--start"), 0, 0, message) if fault is None else fault(name, message))
    refuse(faults)
    return values


# -- in a worker process -------------------------------------------------------------------------


def hosted_drive(log: Log, fmu: Path, interpolated: frozenset[str], table: Path) -> Drive:
    """Return a `Drive` of this worker process, whose rows are written into the file `table` for the caller."""
    claim(fmu)
    drive, progress = Drive(log, fmu, interpolated=interpolated), here.progress
    here.share_log(drive.block)
    drive._new_rows = lambda rows, columns: SharedRows(
        mapped_table(table, rows, columns), made=progress.made, doing=progress.doing
    )
    return drive


def _there(method: str) -> Any:
    """Return a method that calls the method of this name in the worker."""
    return lambda self, *arguments: self._ask(method, *arguments)


class DriveApart(Drive):
    """A drive whose FMU runs in a worker process, which loads it again after a crash."""

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
        self._worker, self._limits, self._full = worker, limits or Limits(), log  # basis of copies with other readings
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
        """Run the FMU as `Drive.run_and_keep`; after an interruption, `left` contains the rows so far."""
        steps = self._steps(first, last)
        self.left = None
        try:
            answer: tuple[Array, dict[int, Own]]
            answer = self._ask("run_and_keep", first, last, start, rows, memory, times=steps.reached.tolist())
        except BaseException:
            finished = read_table(self._file, self._worker.progress.made[0], len(self.outputs))
            self.left = self._at_rows(finished, steps.reached, first, last)
            raise
        self._count(steps)
        return answer

    def _ask(self, method: str, *arguments: Any, times: Any = ()) -> Any:
        """Call a method in the worker; `times` are the times [s] of the rows that the call computes."""
        if not self._remote.is_made:
            self._worker.start()
            self._worker.remove_if_killed(self._file.parent)
            allocate(self._file, 8 * self._most * len(self.outputs))
            self._remote.make(self._watch(()))
        return self._remote.call("answer", method, self.given, *arguments, watch=self._watch(times))

    def _watch(self, times: Any) -> Watch:
        begin = float(self.log.time[0])
        driven, progress = self._driven[0], self.progress
        return Watch(
            [PLANT_COMPONENT],
            [fmi_calls(self.description)],
            lambda made, call: times[min(max(0, made - 1), len(times) - 1)] if times else begin,
            self._limits,
            8 * len(self.outputs),
            self._worker.spent,
            None if progress is None else lambda made: progress(driven + made),
        )


def drive_in(worker: Worker | None, log: Log, fmu: Path, *, limits: Limits | None = None, **options: Any) -> Drive:
    """Return a drive of an FMU in the worker process, or in this process without one; options are those of `Drive`."""
    return Drive(log, fmu, **options) if worker is None else DriveApart(worker, log, fmu, limits=limits, **options)
