"""`Subject`: everything that estimation, refinement and experiments ask of an object that can be refined.

A `Model` is one (`ModelSubject`). An object written by hand is one if its class derives from `Subject` and gives values
to the members without a default. Symbols, printed C and Jacobians are no part of the interface: a kernel may be Python,
a C library, or a foreign FMU in a worker process that takes finite differences.

Fits explore through `kernel`. Proofs replay logs through `replayer`, which holds what is delivered. Both are asked from
several threads: a kernel that cannot run twice at a time takes a lock of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, Self

from cosim.base.arrays import Array, Rows
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.kernel.kernel import Data, Kernel
from cosim.logs.log import Log
from cosim.model.quantities import Parameter, Quantity, parameters_of
from cosim.model.traits import Traits
from cosim.residuals.remote_drive import MODULES
from cosim.residuals.windows import Replay
from cosim.subject.candidates import Candidate

Predict = Callable[[Mapping[str, Rows]], Mapping[str, Array]]  # outputs one row ahead, without readings that are named


@dataclass(frozen=True, eq=False)
class Start:
    """Where a replay begins, as a filter knows it by then.

    states:  state of the kernel → value
    memory:  remembered values of the kernel, in its order
    per_log: parameter that differs from log to log → value
    """

    states: Mapping[str, float]
    memory: Array
    per_log: Mapping[str, float] = field(default_factory=dict)


class Workplace:
    """Context: a folder for files of a refine, limits of calls, and a worker process that starts when it is needed."""

    def __init__(self, folder: Path, limits: Limits | None = None, *, in_process: bool = False) -> None:
        self.folder, self.limits, self.in_process = folder, limits, in_process
        self._open = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: Any) -> None:
        self._open.__exit__(*raised)

    @cached_property
    def worker(self) -> Worker | None:
        """Return the process that holds FMUs; None where they are loaded into this one."""
        return None if self.in_process else self._open.enter_context(Worker(*MODULES))


class Replayer(Protocol):
    """Replays of logs through one object.

    through: how refine.json calls the way: `native` or `python` of an FMU, `own` of an object without one
    """

    through: str

    def replays(
        self, log: Log, data: Data, values: Mapping[str, float], starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield a replay for each horizon [s], in the order of `starts`.

        A run begins at each row of `starts[horizon]`, numbered as in `log`, and ends where the next one begins. The row
        of a start is not predicted. A table (`log.table`) has one replay, each row from its own inputs.
        data:   the log in equal steps, as the kernel takes it: commands before a start are in it
        values: parameter → value, those of this log
        Raises SimulationError if the object fails.
        """


class Subject(Protocol):
    """An object that can be refined.

    title:       name in reports
    inputs, outputs, states: signals with units; `states` without unknown inputs of equations
    horizon:     length of the replays by which it is judged [s]; infinite: one free run over a log
    rate:        step that it is made for [s]
    parameters:  its own parameters, each with its tolerance where one is stated
    candidate_parameters: parameters of its candidates, `candidate.parameter` → declaration; those of sensors are not
                 among them
    values:      every number that its kernel takes → value; candidates at neutral

    The rest has a default.
    calibrated:  own parameters that every fit recalibrates, those with a tolerance beside them
    sensors:     errors that its sensors may have
    sensor_variance, start_variance: variance of the noise of outputs, and of states at the start of a log
    present:     names of candidates that it has already: more of one is a wrong parameter
    excursion:   signal → how far from its start an experiment may take it
    told_apart_by: rivals → the experiment that separates them, in words
    drawn_against: candidate → signals to draw it against
    only_known:  parameters that no filter can learn while it runs, as a delay of commands
    static:      it has no states, and a log is a table without time
    source:      where it comes from, for the provenance
    """

    title: str
    inputs: Sequence[Quantity]
    outputs: Sequence[Quantity]
    states: Sequence[Quantity]
    horizon: float
    rate: float
    parameters: Sequence[Parameter]
    candidate_parameters: Mapping[str, Parameter]
    values: Mapping[str, float]

    calibrated: Sequence[str] = ()
    sensors: Sequence[type[Any]] = ()  # subclasses of cosim.model.SensorError
    sensor_variance: Mapping[str, float] = {}
    start_variance: Mapping[str, float] = {}
    present: frozenset[str] = frozenset()
    excursion: Mapping[str, float] = {}
    told_apart_by: Mapping[frozenset[str], str] = {}
    drawn_against: Mapping[str, tuple[str, ...]] = {}
    only_known: frozenset[str] = frozenset()
    static: bool = False
    source: str = "an object of Python"

    # -- to be written ------------------------------------------------------------------------

    def candidates(self, varied: Sequence[str]) -> Sequence[Candidate]:
        """Return every hypothesis about what is missing or wrong.

        varied: inputs that are not constant in some log; a parameter that needs others is no candidate
        """
        ...

    def kernel(self, measured: Sequence[str], *, unnamed: bool = False, constant: Sequence[str] = ()) -> Kernel:
        """Return the filter over a log that measures these outputs; it is asked for more than once.

        unnamed:  with terms of no catalogue (`cosim.kernel.nameless`), if the subject has any
        constant: parameters that are states without change, to be learnt in the filter; InputError if it cannot
        """
        ...

    def start(self) -> Mapping[str, float]:
        """Return the start value of each state."""
        ...

    def replayer(self, place: Workplace) -> Replayer:
        """Return what replays logs through this object as it is delivered."""
        ...

    def refined(self, claims: Mapping[str, float]) -> Subject:
        """Return the subject with other values of parameters: those of claimed candidates are claims too."""
        ...

    # -- with a default -----------------------------------------------------------------------

    @property
    def declared(self) -> Mapping[str, Parameter]:
        """Return every parameter by name."""
        return {p.name: p for p in self.parameters} | {**self.candidate_parameters} | {**self.sensor_parameters}

    @property
    def sensor_parameters(self) -> Mapping[str, Parameter]:
        """Return the parameters of errors of the sensors, by `sensor.value`."""
        return {f"{kind.name}.{p.name}": p for kind in self.sensors for p in parameters_of(kind)}

    @property
    def late(self) -> Mapping[str, tuple[str, ...]]:
        """Return each parameter that is a time by which readings are late → the outputs that are."""
        return {f"{kind.name}.value": kind.affected() for kind in self.sensors if kind.late}

    @property
    def traits(self) -> Traits:
        """Return further declarations about its signals, for the checks of logs."""
        return Traits(static=self.static)

    @property
    def shown(self) -> frozenset[str]:
        """Return the states that an output of the same name shows as they are."""
        return frozenset(q.name for q in self.states) & {q.name for q in self.outputs}

    def substeps(self, step: float) -> int:
        """Return the number of integration steps in a step [s]; fits take fewer where that makes no difference."""
        return 1

    def settling(self, states: Sequence[str]) -> float:
        """Return the time [s] after which states that no noise reaches have forgotten a wrong start."""
        return 0.0

    def prediction(self, log: Log) -> Predict | None:
        """Return what predicts a log one row ahead, to tell spikes of a recorder from motion; None: neighbours do."""
        return None

    def nameless(self, signal: str) -> tuple[Callable[..., Any], Sequence[str]] | None:
        """Return a term of no catalogue as a function, and the signals that it depends on; None without such terms.

        The function takes time, states and inputs, all of them, in their order.
        """
        return None

    def quick_replayer(self, place: Workplace) -> Replayer | None:
        """Return a faster `replayer`, which counts as long as it equals it; None: there is none.

        Raises InputError with the reason where there should be one.
        """
        return None

    def write(self, scratch: Path, folder: Path, name: str) -> Sequence[Path]:
        """Write the files that hold the subject to `scratch`, from where they move to `folder`; return them.

        name: `refined` or `nearest`. Nothing is written of a subject that only lives in Python.
        """
        return ()

    def use(self, folder: Path) -> Sequence[str]:
        """Return the command that uses files in `folder`; empty without files."""
        return ()
