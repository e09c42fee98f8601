"""`Subject`: the interface of objects that can be fitted, refined and used in experiments.

`ModelSubject` implements it for a `Model`. Any other class derives from `Subject` and defines the members without a
default. Symbols, printed C and Jacobians are not required: a kernel may be Python, a C library, or a foreign FMU in a
worker process with finite differences.

Fits use `kernel`. Final replays use `replayer`, which contains the delivered object. Several threads call both, so a
kernel that is not thread-safe needs a lock.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, Self, runtime_checkable

from cosim.core.arrays import Array, NamedArrays, NamedValues, Rows
from cosim.estimation.kernel.kernel import Data, Kernel
from cosim.estimation.subject.candidates import Candidate
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.logs.log import Log
from cosim.model.quantities import Parameter, Quantity, parameters_of
from cosim.model.traits import Traits
from cosim.residuals.drive import REPLAY_MODULES
from cosim.residuals.windows import Replay

Predict = Callable[[Mapping[str, Rows]], NamedArrays]  # ignored readings by output → one-step predictions of outputs


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a replay, estimated by the filter from past data.

    Attributes:
        states: State of the kernel → value.
        memory: Values of the memory of effects, in the kernel's order.
        per_log: Parameter with a value per log → value.
    """

    states: NamedValues
    memory: Array
    per_log: NamedValues = field(default_factory=dict)


class Workplace(ExitStack):
    """Context with a folder for files, limits of calls, and a worker process started on demand."""

    def __init__(self, folder: Path, limits: Limits | None = None, *, in_process: bool = False) -> None:
        super().__init__()
        self.folder, self.limits, self.in_process = folder, limits, in_process

    @cached_property
    def worker(self) -> Worker | None:
        """Return the worker process of the FMUs; None if FMUs are loaded into this process."""
        return None if self.in_process else self.enter_context(Worker(*REPLAY_MODULES))


class Replayer(Protocol):
    """An object that replays logs through an FMU or model.

    Attributes:
        through: Entry in refine.json: `native` or `python` for an FMU, `own` for an object that is not an FMU.
    """

    through: str

    def replays(
        self, log: Log, data: Data, values: NamedValues, starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield the replayed outputs for each horizon [s], in the order of `starts`.

        A replay begins at each row of `starts[horizon]`, numbered as in `log`, and ends at the next start. Start rows
        have no prediction.

        Args:
            data: Log in equal steps with the commands before a start.
            values: Parameter → value for this log.

        Raises:
            SimulationError: The object fails.
        """


@runtime_checkable
class Subject(Protocol):
    """An object that can be refined.

    Attributes:
        title: Name in reports.
        inputs, outputs, states: Signals with units. Unknown inputs of equations are not `states`.
        horizon: Duration of the replays that measure errors [s]; infinite: one free run over a log.
        rate: Communication step for which the object is designed [s].
        parameters: Base parameters, each with an optional tolerance.
        candidate_parameters: `candidate.parameter` → declaration, without sensors.
        values: Value of every parameter of the kernel; candidates are at neutral. (All attributes below have a
            default.)
        calibrated: Base parameters that are free in every fit, even without a stated tolerance.
        sensors: Possible sensor errors.
        sensor_variance, start_variance: Noise variance of outputs, and variance of states at the start of a log.
        present: Candidates already in the object; a change of their values counts as a wrong parameter.
        excursion: Signal → allowed deviation from its start in an experiment.
        told_apart_by: Candidates → sentence on the experiment that separates them.
        inestimable: Parameters that a filter cannot estimate, such as a delay of commands.
        probed: True for an FMU, whose terms are those of a general catalogue.
        display: Unit → name of its display unit, factor and offset to its values.
        source: Origin of the subject, for provenance in reports.
        undelivered: Reason why `write` cannot write the FMU; "" if it can.
        missing_platforms: Platforms of the original FMU that the delivered FMU does not support.
        untried: Effects that cannot be candidates, with the reason.
    """

    title: str
    inputs: Sequence[Quantity]
    outputs: Sequence[Quantity]
    states: Sequence[Quantity]
    horizon: float
    rate: float
    parameters: Sequence[Parameter]
    candidate_parameters: Mapping[str, Parameter]
    values: NamedValues

    calibrated: Sequence[str] = ()
    sensors: Sequence[type[Any]] = ()  # subclasses of cosim.model.SensorError
    sensor_variance: Mapping[str, float] = {}
    start_variance: Mapping[str, float] = {}
    present: frozenset[str] = frozenset()
    excursion: Mapping[str, float] = {}
    told_apart_by: Mapping[frozenset[str], str] = {}
    inestimable: frozenset[str] = frozenset()
    probed: bool = False
    display: Mapping[str, Sequence[Any]] = {}
    source: str = "an object of Python"
    undelivered: str = ""
    missing_platforms: Sequence[str] = ()
    untried: str = ""

    # -- required members ------------------------------------------------------------------------

    def candidates(self, varied: Sequence[str]) -> Sequence[Candidate]:
        """Return all candidates: effects, sensor errors and parameters that may be missing or wrong.

        Args:
            varied: Inputs that vary in some log. Parameters that need the variation of another input are left out.
        """
        ...

    def kernel(self, measured: Sequence[str], *, unnamed: bool = False, constant: Sequence[str] = ()) -> Kernel:
        """Return a filter kernel for logs with these measured outputs.

        Args:
            unnamed: Include unmodelled dynamics (`cosim.estimation.kernel.generate`), if the kernel supports them.
            constant: Parameters that are constant states, which the filter estimates.

        Raises:
            InputError: A parameter cannot be a constant state.
        """
        ...

    def start(self) -> NamedValues:
        """Return the start value of each state."""
        ...

    def replayer(self, place: Workplace) -> Replayer:
        """Return a replayer of logs for the delivered FMU or model, stored at `place`."""
        ...

    def refined(self, claims: NamedValues) -> Subject:
        """Return the subject with other parameter values, such as claimed ones."""
        ...

    # -- members with a default ------------------------------------------------------------------

    @property
    def declared(self) -> Mapping[str, Parameter]:
        """Return every parameter by name."""
        return {p.name: p for p in self.parameters} | {**self.candidate_parameters} | {**self.sensor_parameters}

    @property
    def sensor_parameters(self) -> Mapping[str, Parameter]:
        """Return the parameters of sensor errors by `sensor.value`."""
        return {f"{kind.name}.{p.name}": p for kind in self.sensors for p in parameters_of(kind)}

    @property
    def traits(self) -> Traits:
        """Return further signal properties for the checks of logs."""
        return Traits()

    def start_of_log(self, readings: NamedValues) -> NamedValues:
        """Return the start value of each state in a log.

        Args:
            readings: State → first reading of the output with its name.
        """
        return {**self.start(), **readings}

    @property
    def measured_states(self) -> frozenset[str]:
        """Return states measured by outputs of the same name."""
        return frozenset(q.name for q in self.states) & {q.name for q in self.outputs}

    def substeps(self, step: float) -> int:
        """Return the number of integration steps in a communication step [s]; fits may use fewer."""
        return 1

    def with_finer_steps(self, times: float) -> Self:
        """Return the subject with `times` as many integration steps."""
        return self

    def prediction(self, log: Log) -> Predict | None:
        """Return a one-step predictor, used to detect outliers; None to detect them by neighbouring readings."""
        return None

    def quick_replayer(self, place: Workplace) -> Replayer | None:
        """Return a faster replayer with equal results; None if there is none.

        Raises:
            InputError: The faster replayer cannot be made; the message says why.
        """
        return None

    def write(self, scratch: Path, folder: Path, name: str) -> Sequence[Path]:
        """Write the subject's files to `scratch`, from which they will be moved to `folder`; return their paths.

        A subject that exists only in Python writes nothing.

        Args:
            name: `refined` or `nearest`.
        """
        return ()

    def use(self, folder: Path, name: Literal["refined", "nearest"] = "refined") -> Sequence[str]:
        """Return a command line that uses the delivered files in `folder`; empty without files."""
        return ()
