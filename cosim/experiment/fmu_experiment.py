"""Experiments with an FMU: its usual response, the subject made of it, and the rig that plays signals through it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from cosim.core.errors import Fault, refuse
from cosim.estimation.data import data_of, start_state
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.model_subject import neutral_values
from cosim.experiment.rigs import OpenLoop, Ranges, Signals, Trial, limits_and_ranges
from cosim.fmi.description import read_description
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.logs.log import Log
from cosim.model.model import Model
from cosim.probing.log_runs import sine_course
from cosim.probing.places import probe_places
from cosim.probing.prober import quantities
from cosim.residuals.drive import MODULES, DriveApart, model_signals
from cosim.terms.fmu_model import FmuModel, fmu_model
from cosim.terms.language import Term, with_place

# Kinds of terms at one place that small or short experiments confuse.
CONFUSED = (
    ("delay", "lag", "second_order_lag", "rate_limit"),
    ("dead_band", "play"),
    ("gain", "saturation", "square_law"),
    ("coulomb", "viscous", "quadratic_drag"),
    ("cubic_spring", "cogging"),
    ("leak", "growing_leak", "overflow"),
)


class FmuOpenLoop(OpenLoop):
    """Open-loop rig that plays signals through the library of an FMU, with the terms of a hypothesis.

    Args:
        first: Output → reading at the start.
    """

    def __init__(
        self,
        subject: FmuSubject,
        first: Mapping[str, float],
        limits: Mapping[str, float],
        ranges: Ranges,
        duration: float,
    ) -> None:
        super().__init__(subject.model, limits, ranges, duration)
        self.subject, self.first = subject, first
        self.kernel = subject.kernel([q.name for q in subject.outputs])

    def play(self, model: Model, signals: Signals) -> Trial:
        """Simulate the FMU with the parameters of a model, and input signals clipped to the ranges."""
        inputs = self.commands(model, signals)
        time = model.rate * np.arange(len(next(iter(signals.values()))), dtype=np.float64)
        names = [q.name for q in model.outputs]
        readings = {n: np.where(np.arange(time.size) == 0, self.first.get(n, np.nan), np.nan) for n in names}
        log = Log(Path("trial.csv"), time, inputs, readings, {}, model.rate, {}, {})
        layout = self.kernel.layout
        data = data_of(self.subject, log, layout)
        values = neutral_values(model)
        p = np.array([values.get(name, 1.0) for name in layout.parameters])
        x0 = start_state(self.subject, data, layout.outputs, layout.states)
        table = self.kernel.simulate(data, p, x0, np.zeros(layout.memory)).outputs
        return Trial(time, signals, inputs, {}, dict(zip(names, table.T, strict=True)))

    def connections(self, model: Model, trial: Trial, variance: Mapping[str, float]) -> Iterator[str]:
        """Yield the connection of every input."""
        assert isinstance(model, FmuModel)
        yield from (f'  - {{from: excitation.{q.name}, to: "plant.{model.variables[q.name]}"}}' for q in model.inputs)


def subject_of_fmu(
    fmu: Path, duration: float | None, limits: Sequence[str], ranges: Sequence[str]
) -> tuple[FmuSubject, dict[str, float]]:
    """Return the subject of an FMU that was probed along a pulse of each input, and its first outputs.

    Args:
        duration: Duration of the pulses [s]; None for the duration and step that the FMU declares.

    Raises:
        InputError: An input has no limit.
        FmuError: The FMU cannot be loaded.
        SimulationError: The FMU fails.
    """
    description = read_description(fmu)
    course = sine_course(description)
    step = float(course.time[1] - course.time[0])
    time = step * np.arange(round((duration or float(course.time[-1])) / step) + 1, dtype=np.float64)
    signals = model_signals(fmu)
    inputs, outputs = (quantities(description, [q.name for q in group]) for group in signals)
    named = [tuple(replace(q, name=with_place(q.name)) for q in group) for group in (outputs, inputs, outputs)]
    bare = fmu_model(fmu.stem, (named[0], named[1], named[2]), (), (), rate=step)  # with its signals only
    faults = list[str]()
    reaches, spans = limits_and_ranges(bare, limits, ranges, {}, faults)
    refuse(Fault(fmu, 0, 0, fault) for fault in faults)
    rig = OpenLoop(bare, reaches, spans, float(time[-1]))
    commands = rig.commands(bare, rig.usual_signals(time))
    played = {q.name: commands[with_place(q.name)] for q in inputs}
    units = {q.name: q.unit for group in signals for q in group}
    log = Log(fmu.with_suffix(".csv"), time, played, {}, units, step, units, {})
    with Worker(*MODULES) as worker, DriveApart(worker, log, fmu) as drive:
        table = drive.run(0, time.size - 1, {})
        log = replace(log, outputs=dict(zip(drive.outputs, table.T, strict=True)))
    subject = FmuSubject.of_fmu(probe_places(fmu, [log]).structure, [log], limits=Limits())
    return subject, first_outputs(log)


def first_outputs(log: Log) -> dict[str, float]:
    """Return output → its first reading in a log, in names of the model."""
    readings = {with_place(n): values[np.isfinite(values)] for n, values in log.outputs.items()}
    return {name: float(values[0]) for name, values in readings.items() if values.size}


def confused_groups(model: Model) -> list[set[str]]:
    """Return the groups of terms of an FMU that are hard to separate: kinds of `CONFUSED` at one place."""
    groups: list[set[str]] = []
    terms = [kind for kind in model.catalogue if issubclass(kind, Term)]
    for _, at in groupby(sorted(terms, key=lambda t: t.place.name), key=lambda t: t.place.name):
        kinds = {t.kind: t.name for t in at}
        kinds |= {"delay": "delay"} if "lag" in kinds and any(k.name == "delay" for k in model.catalogue) else {}
        groups += [{kinds[k] for k in confused if k in kinds} for confused in CONFUSED]
    return [group for group in groups if len(group) > 1]
