"""Behaviour of a binary beyond its equations, by trying: reset, parameters, repetition, folders, memory and steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Crashed, FmuError, InputError, SimulationError, TimedOut
from cosim.base.messages import Message, Note, Template
from cosim.base.scratch import temporary_folder
from cosim.blocks.derivatives import REALS, reals
from cosim.blocks.description import Way, state_names, unit_of, ways
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.logs.log import Log
from cosim.probing.log_runs import SAME, Course, amplitude_of, limits_of, moved_within, sine_course
from cosim.probing.parameter_trials import settable_parameters, trial_values
from cosim.probing.prober import LIMITS, MODULES, Prober, quantities
from cosim.probing.trial_runs import (
    Trial,
    event_shares,
    growth,
    outputs_after_reset,
    outputs_after_rollback,
    outputs_again,
    outputs_in,
    outputs_of,
    outputs_together,
    outputs_with_step,
    time_of,
)
from cosim.storage.archive import unpack

ROWS, FEW_ROWS = 60, 6  # rows of a trial, and of one that only may fail
MOST_PARAMETERS = 3  # acting parameters that are set at several moments
NOISE = 5.0  # difference relative to that of equal simulations, from which it is another result
LEAK = 256e3  # growth per instance that is no waste of the allocator [bytes]
MANY = 1000  # instances of an estimate
ALWAYS = 0.9  # events per step
DOUBLINGS = 6  # of the step, in the search for an own step
OWN, CONVERGED = 0.2, 0.05  # difference of results relative to their course: of too short steps, of sound ones
ROUNDED = 0.05  # accuracy of an own step
STILL = 0.3  # share of rows without any change that is no rest


@dataclass
class Behaviour:
    """Behaviour of an FMU, each item by trying; None where it could not be tried.

    Attributes:
        way: Interface of the simulations.
        resets: A reset restores the start.
        keeps_early, keeps_inside: Parameters act when set before initialization mode, or inside it only.
        repeats: Equal simulations have equal results, in the same and in another process.
        independent: Instances in one process do not disturb each other.
        moves: Results do not depend on the working directory or on the folder of the unpacked FMU.
        growth: Memory per instance that remains after its end [bytes].
        own_step: Step of its own above the asked step [s]; 0 without one.
        rolls_back: A saved state is restored with all outputs.
        events: Events per step in model exchange.
        failing: Parameters with a value at which the FMU crashes, hangs or stops.
        findings: Sentences about everything that deviates, with codes.
    """

    fmu: Path
    way: Way
    resets: bool | None = None
    keeps_early: bool | None = None
    keeps_inside: bool | None = None
    repeats: bool | None = None
    independent: bool | None = None
    moves: bool | None = None
    growth: float | None = None
    own_step: float | None = None
    rolls_back: bool | None = None
    events: float | None = None
    failing: tuple[str, ...] = ()
    findings: list[Message] = field(default_factory=list)

    def has(self, template: Template) -> bool:
        """Return whether there is a finding of a kind."""
        return any(finding.code == template.code for finding in self.findings)


def probe_behaviour(
    fmu: Path,
    logs: Sequence[Log] = (),
    values: Mapping[str, float] = MappingProxyType({}),
    *,
    way: Way | None = None,
    limits: Limits = LIMITS,
) -> Behaviour:
    """Return the behaviour of a binary, from short simulations with the inputs of the first log.

    Args:
        values: Start values by name.
        way: Interface of the simulations; None prefers co-simulation.
        limits: Limits of each simulation.

    Raises:
        InputError: The FMU lacks the interface.
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start with its own parameters.
    """
    path = Path(fmu).resolve()
    with ExitStack() as stack:
        place = stack.enter_context(temporary_folder("probe"))
        worker = stack.enter_context(Worker(*MODULES))
        prober = Prober(path, values, worker, place, limits)
        offered = ways(prober.description)
        chosen = way or offered[0]
        if chosen not in offered:
            raise InputError.at(path, f"has no usable interface for {chosen}; it offers {', '.join(offered)}")
        unpack(path, place)
        course = Course.of(logs[0]) if logs else sine_course(prober.description, values)
        trials = Trials(prober, chosen, _excited(prober, course.first(ROWS)))
        return trials.all()


def _excited(prober: Prober, course: Course) -> Course:
    """Return the course with inputs off their rest, so that every simulation moves."""
    for variable in reals(prober.description, "input"):
        if variable.name in course.inputs:
            held = course.inputs[variable.name]
            size = float(np.std(held)) or amplitude_of(variable, float(held[0]))
            course = course.with_input(variable.name, moved_within(held, size, limits_of(variable)))
    return course


@dataclass(frozen=True)
class Difference:
    """Largest difference of an output between simulations, relative to the noise of equal ones.

    Attributes:
        share: Difference relative to the largest value.
    """

    output: str
    difference: float
    share: float

    @property
    def fields(self) -> dict[str, Any]:
        """Return the fields of a message."""
        return {"output": self.output, "difference": self.difference}


class Trials:
    """All trials of one FMU; each costs at most its time limit, and a failure costs only its own item."""

    def __init__(self, prober: Prober, way: Way, course: Course) -> None:
        self._prober = prober
        description = prober.description
        states = frozenset(state_names(description)) - {v.name for v in reals(description, "output")}
        self._trial = Trial(prober.fmu, way, course, states)
        outputs = [s.name for s in self._trial.signals()]
        self._names, self.found = outputs, Behaviour(prober.path, way)
        self._table, self._noise = np.zeros((0, len(outputs))), np.zeros(len(outputs))

    def all(self) -> Behaviour:
        """Return the behaviour after all trials."""
        table, stop = self._prober.call(outputs_of, self._trial)
        if len(table) < 2:
            raise stop or SimulationError(
                self._prober.fmu.name,
                float(self._trial.course.time[0]),
                "the log has too few rows to probe the FMU; give a longer one",
            )
        if stop is not None:
            self._note(Note(f"{stop!s}; its behaviour is tried before that time"))
            self._trial = self._trial.along(self._trial.course.first(len(table)))
        self._table = table
        self._quick = self._prober.hurried(self._prober.call(time_of, self._trial))
        for probe, sentence in (
            (self._repeat, "a repeated simulation"),
            (self._instances, "a second instance in a process"),
            (self._reset, "a reset"),
            (self._parameters, "a parameter"),
            (self._folders, "another folder"),
            (self._memory, "the making of several instances"),
            (self._own_step, "another step"),
            (self._rollback, "a rollback"),
            (self._events, "a simulation in model exchange"),
        ):
            self._guarded(probe, sentence)
        self._declared()
        return self.found

    def _guarded(self, probe: Callable[[], None], sentence: str) -> None:
        try:
            probe()
        except (SimulationError, FmuError) as error:
            self._note(f"{error!s} (while {sentence} was tried)")

    def _note(self, message: Message) -> None:
        self.found.findings.append(message)

    def _run(self, job: Callable[..., Any], *arguments: Any) -> Any:
        return self._prober.call(job, *arguments, limits=self._quick)

    def _difference(self, table: Array, against: Array | None = None) -> Difference | None:
        """Return the difference of a table from the first simulation or from another, None for equal ones."""
        base = self._table if against is None else against
        rows = min(len(base), len(table))
        size = np.maximum(np.abs(self._table).max(axis=0), SAME)
        gaps = np.nan_to_num(np.abs(table[:rows] - base[:rows])).max(axis=0, initial=0.0)
        if rows < max(len(base), len(table)):
            gaps = np.maximum(gaps, size)
        beyond = gaps / (SAME * size + NOISE * self._noise)
        worst = int(np.argmax(beyond)) if beyond.size else 0
        if not beyond.size or beyond[worst] <= 1.0:
            return None
        return Difference(self._names[worst], float(gaps[worst]), float(gaps[worst] / size[worst]))

    # -- trials -------------------------------------------------------------------------------

    def _repeat(self) -> None:
        first, second = self._run(outputs_again, self._trial)
        with Worker(*MODULES) as other:
            elsewhere, _ = self._prober.in_worker(other).call(outputs_of, self._trial, limits=self._quick)
        differences = [self._difference(first), self._difference(second, first), self._difference(elsewhere)]
        worst = max(filter(None, differences), key=lambda d: d.share, default=None)
        self.found.repeats = worst is None
        if worst is not None:
            self._note(
                (
                    "two simulations with equal values differ: {output} by {difference:.3g}, {share:.2g} of its "
                    "largest value; no estimate is more accurate than that"
                ).format(**worst.fields, share=worst.share)
            )
        for table in (first, second, elsewhere):
            rows = min(len(table), len(self._table))
            gaps = np.abs(table[:rows] - self._table[:rows]).max(axis=0, initial=0.0)
            self._noise = np.maximum(self._noise, gaps)

    def _instances(self) -> None:
        """Simulate two instances of a process; differences of equal simulations are known before."""
        differences = map(self._difference, self._run(outputs_together, self._trial))
        worst = max(filter(None, differences), key=lambda d: d.share, default=None)
        self.found.independent = worst is None
        if worst is not None:
            self._note(
                (
                    "two instances in one process disturb each other: {output} differs by {difference:.3g}; each "
                    "needs a process of its own"
                ).format(**worst.fields)
            )

    def _reset(self) -> None:
        prefix = "fmi3" if self._prober.description.fmiVersion.startswith("3") else "fmi2"
        try:
            table = self._run(outputs_after_reset, self._trial)
        except (Crashed, TimedOut):
            self.found.resets = False
            raise
        except SimulationError as error:
            self.found.resets = False
            self._note(Note(f"refuses a reset ({error.reason}); it is instantiated again for every simulation"))
            return
        difference = self._difference(table)
        self.found.resets = difference is None
        if difference is not None:
            self._note(
                (
                    "{function} returns OK but does not restore the start: {output} differs by {difference:.3g} in "
                    "the next simulation; it is instantiated again for every simulation"
                ).format(function=f"{prefix}Reset", **difference.fields)
            )

    def _parameters(self) -> None:
        """Set each parameter at all moments; the first that act also before and inside initialization mode only."""
        forgotten, failing, kept = list[str](), list[str](), 0
        for variable in settable_parameters(self._prober.description):
            value = float(self._prober.values.get(variable.name, variable.start))
            try:
                moments = self._moments(variable, value, everything=kept + len(forgotten) < MOST_PARAMETERS)
            except SimulationError as error:
                failing.append(variable.name)
                fields = {"name": variable.name, "value": self._tried, "start": value}
                self._note(
                    "{error} (with {name} = {value:g}; its value in the file is {start:g})".format(
                        error=str(error), **fields
                    )
                )
                continue
            if moments is None:
                continue
            early, inside = moments
            kept += early
            if not early and inside:
                forgotten.append(variable.name)
        self.found.failing = tuple(failing)
        if forgotten or kept:
            self.found.keeps_early = not forgotten
            self.found.keeps_inside = True
        if forgotten:
            self._note(
                f"forgets parameters that are set before initialization mode ({', '.join(forgotten)}); they are "
                "set again inside it"
            )

    def _moments(self, variable: Any, value: float, *, everything: bool) -> tuple[bool, bool] | None:
        """Return whether a value acts if set before initialization mode, and if set inside it; None if it never acts.

        Raises:
            SimulationError: The FMU fails with a value near its own.
        """
        (quantity,) = quantities(self._prober.description, [variable.name])
        for self._tried in trial_values(value, quantity.bounds)[:2]:
            values = {variable.name: self._tried}
            trial = self._trial if everything else self._trial.along(self._trial.course.first(FEW_ROWS))
            both, stop = self._run(outputs_of, trial.with_values(values))
            if stop is not None:
                raise stop
            if not everything or self._difference(both) is None:
                continue
            before, _ = self._run(outputs_of, self._trial.with_values(values, "before"))
            if self._difference(before, both) is None:
                return True, True
            inside, _ = self._run(outputs_of, self._trial.with_values(values, "inside"))
            return False, self._difference(inside, both) is None
        return None

    def _folders(self) -> None:
        self.found.moves = True
        with temporary_folder("elsewhere") as folder:
            unpack(self._prober.path, folder / "unpacked")
            there = self._run(outputs_in, self._trial, folder)
            moved, _ = self._run(outputs_of, self._trial.unpacked_in(folder / "unpacked"))
        for name, table in (("working directory", there), ("folder to which it is unpacked", moved)):
            difference = self._difference(table)
            if difference is not None:
                self.found.moves = False
                self._note(
                    "depends on the {folder}: {output} differs by {difference:.3g} in another one".format(
                        folder=name, **difference.fields
                    )
                )

    def _memory(self) -> None:
        self.found.growth = size = max(0.0, self._run(growth, self._trial))
        if size > LEAK:
            self._note(
                f"keeps {size / 1e6:.2g} MB of memory for each instance after its end; {MANY} instances need "
                f"{MANY * size / 1e9:.2g} GB"
            )

    def _own_step(self) -> None:
        """Compare results after the same time by steps of several lengths, with constant inputs."""
        if self._trial.way != "co-simulation":
            return
        step, count = self._trial.course.step, 2**DOUBLINGS
        tables = [self._run(outputs_with_step, self._trial, step * 2**k, count // 2**k) for k in range(DOUBLINGS)]
        if any(len(table) != count // 2**k + 1 for k, table in enumerate(tables)):
            return
        course = np.maximum(np.ptp(np.concatenate(tables), axis=0), SAME)
        gaps = [float((np.abs(a[-1] - b[-1]) / course).max(initial=0.0)) for a, b in pairwise(tables)]
        self.found.own_step = 0.0
        rising = gaps[0] > OWN and min(gaps) < CONVERGED
        if rising and int(np.argmin(gaps)) > 0:
            self.found.own_step = own = self._own(tables[0], step, course)
            if own > step:
                self._note(
                    f"makes steps of its own of about {own:.3g} s, above the step of {step:.3g} s that is asked "
                    f"for: its results are wrong there; use model exchange, or steps of whole {own:.3g} s"
                )
            return
        moved = np.diff(self._table, axis=0) != 0.0
        still = 1.0 - moved.any(axis=1).mean()
        if moved.any() and still > STILL and moved[len(moved) // 2 :].any():
            self.found.own_step = own = roundest(step / max(1e-3, 1.0 - still))
            self._note(
                f"its outputs change only every {own:.3g} s or so, with steps of {step:.3g} s; use steps of "
                f"whole {own:.3g} s"
            )

    def _own(self, table: Array, step: float, course: Array) -> float:
        """Return the own step: so many short steps reach the result of a single long one."""
        count = len(table) - 1
        _, wanted = self._run(outputs_with_step, self._trial, step * count, 1)
        distance = (np.abs(table - wanted) / course).sum(axis=1)
        return roundest(step * count / max(1, int(np.argmin(distance))))

    def _rollback(self) -> None:
        part = self._prober.description.coSimulation
        offers = getattr(part, "canGetAndSetFMUstate", False) or getattr(part, "canGetAndSetFMUState", False)
        if self._trial.way != "co-simulation" or not offers:
            return
        self.found.rolls_back = False
        try:
            first, again = self._run(outputs_after_rollback, self._trial, len(self._table) // 3)
        except (Crashed, TimedOut):
            raise
        except SimulationError as error:
            self._note(f"declares that its state can be saved, but refuses it: {error.reason}")
            return
        difference = self._difference(again, first)
        self.found.rolls_back = difference is None
        if difference is not None:
            self._note(
                (
                    "does not come back to a saved state: {output} differs by {difference:.3g} when the same steps "
                    "are repeated; steps are never repeated"
                ).format(**difference.fields)
            )

    def _events(self) -> None:
        if "model-exchange" not in ways(self._prober.description):
            return
        counts, steps = self._run(event_shares, self._trial.by("model-exchange"))
        self.found.events = sum(counts.values()) / steps
        if self.found.events > ALWAYS:
            kind = max(counts, key=lambda name: counts[name])
            self._note(
                f"has events in model exchange at every step: {sum(counts.values())} {kind} events in {steps} "
                "steps; a filter over its states is not possible, its co-simulation is used if it has one"
            )

    def _declared(self) -> None:
        description = self._prober.description
        if not settable_parameters(description):
            self._note("has no real parameter that may be set before initialization; only terms can be added to it")
        if not any(unit_of(v) for v in description.modelVariables if v.type in REALS):
            self._note("declares no unit; numbers are taken as they are")


def roundest(value: float) -> float:
    """Return the number with the fewest digits near an inaccurate value."""
    rounded = (float(f"{value:.{digits}g}") for digits in (1, 2, 3))
    return next((r for r in rounded if abs(r - value) <= ROUNDED * value), value)
