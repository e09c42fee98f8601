"""Models as subjects of refinement: the kernel is generated from the equations; the FMU is replayed and delivered."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from shutil import copyfile
from typing import Any, Literal, Self

from cosim.core.arrays import NamedValues
from cosim.core.units import DISPLAY
from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import Data, Kernel
from cosim.estimation.subject.candidates import Candidate, base_parameter, effect
from cosim.estimation.subject.interface import Predict, Replayer, Start, Subject, Workplace
from cosim.fmi.building.build import class_fmu
from cosim.fmi.building.file import LoadedModel, write_model
from cosim.fmi.building.own_run import predicted_outputs, shown_states
from cosim.fmi.building.refined import NEAREST, REFINED
from cosim.fmi.fmu_build import build
from cosim.fmi.state import MEMORY, Memory
from cosim.logs.log import Log
from cosim.model.integrate import substeps
from cosim.model.model import Effect, Model, overrides
from cosim.model.quantities import parameters_of
from cosim.model.traits import Traits
from cosim.residuals.drive import drive_in
from cosim.residuals.windows import Replay, windows

DELIVERED_FILES = {"refined": REFINED, "nearest": NEAREST}


class ModelSubject(Subject):
    """A model, with the values of its model.yaml, as the subject of a refinement.

    Attributes:
        loaded: Model with origin, parameter values and known sensor errors.
        fmu: FMU of the model; None before it is built.
    """

    def __init__(self, loaded: LoadedModel) -> None:
        model = loaded.model
        self.loaded, self.model = loaded, model
        self.fmu: Path | None = None
        self.title, self.source, self.display = model.title, loaded.source, DISPLAY
        self.inputs, self.outputs, self.states = model.inputs, model.outputs, model.states
        self.horizon, self.rate = model.horizon, model.rate
        self.parameters, self.calibrated, self.sensors = model.parameters, model.calibrated, model.sensors
        own = {p.name for p in model.parameters}
        self.candidate_parameters = {n: p for n, p in model.declared.items() if n not in own}
        self.values = {**neutral_values(model), **loaded.values}
        self.sensor_variance, self.start_variance = model.sensor_variance, model.start_variance
        self.present = frozenset(e.name for e in model.awake)
        self.excursion = model.excursion
        self.told_apart_by = model.told_apart_by
        effects = (*shaping_effects(model.catalogue), *(kind for kind in model.sensors if kind.depends_on_past()))
        self.inestimable = frozenset(f"{e.name}.{p.name}" for e in effects for p in parameters_of(e))

    @classmethod
    def of(cls, model: Model) -> ModelSubject:
        """Return the subject of a model without model.yaml."""
        return cls(LoadedModel(model, ""))

    @property
    def traits(self) -> Traits:
        """Return the signal properties, with rates from the equations."""
        return Traits.of(self.model)

    @property
    def measured_states(self) -> frozenset[str]:
        """Return the states that equal an output of the same name, as tested at a single state."""
        return frozenset(shown_states(self.model))

    def candidates(self, varied: Sequence[str]) -> list[Candidate]:
        """Return effects, sensor errors and base parameters as candidates."""
        found: list[Candidate] = []
        for kind in (*self.model.catalogue, *self.model.sensors):
            c = effect(
                kind.name,
                parameters_of(kind),
                self.values,
                kind="sensor" if kind in self.model.sensors else "effect",
                starts=kind.starts,
                above=kind.at_least,
            )
            if c.name in self.present:  # an effect that the model has is adjusted from its values
                c = replace(c, starts=({name: self.values[name] for name in c.parameters},))
            elif (whole := getattr(kind, "complete", None)) is not None:
                c = replace(c, complete=dict.fromkeys(c.parameters, whole))
            found.append(c)
        # some parameters can be estimated only if certain inputs vary
        suspects = [name for name, inputs in self.model.suspect.items() if any(i in varied for i in inputs)]
        for name in (*self.model.calibrated, *suspects):
            free = base_parameter(self, name, self.values, None)
            found.append(Candidate(name, "parameter", (free,), ({name: self.values[name]},)))
        return found

    def kernel(self, measured: Sequence[str], *, unnamed: bool = False, constant: Sequence[str] = ()) -> Kernel:
        """Return the compiled filter generated from the equations."""
        return kernel(self.model, measured, unnamed, constant)

    def start(self) -> dict[str, float]:
        """Return the start value of each state."""
        return dict(zip((q.name for q in self.states), self.model.start(), strict=True))

    def substeps(self, step: float) -> int:
        """Return the number of integration steps in a communication step [s], within the model's limit."""
        return substeps(step, self.model.substep)

    def with_finer_steps(self, times: float) -> Self:
        """Return the subject with `times` as many integration steps."""
        finer = copy(self)
        finer.model = self.model.with_substep(self.model.substep / times, self.model.chosen_integrator)
        finer.loaded, finer.fmu = replace(self.loaded, model=finer.model), None
        return finer

    def prediction(self, log: Log) -> Predict | None:
        """Return a one-step predictor of the outputs in a log."""
        return partial(predicted_outputs, self.model, log)

    def refined(self, claims: NamedValues) -> ModelSubject:
        """Return the model with the claimed values; sensor errors are stored separately from parameters."""
        loaded = self.loaded
        parameters = {**loaded.parameters, **{n: v for n, v in claims.items() if n not in self.sensor_parameters}}
        sensors = {**loaded.sensors, **{n: v for n, v in claims.items() if n in self.sensor_parameters}}
        model = loaded.model.with_values(parameters)
        return ModelSubject(LoadedModel(model, loaded.source, parameters, sensors))

    def replayer(self, place: Workplace) -> Replayer:
        """Return a replayer of the Python FMU."""
        return FmuReplayer(self.model, self._built(place.folder), place, "python")

    def _built(self, folder: Path) -> Path:
        """Return the Python FMU, built once."""
        if self.fmu is None or not self.fmu.is_file():
            self.fmu = build(self.loaded.recipe(), new_fmu(folder))
        return self.fmu

    def quick_replayer(self, place: Workplace) -> Replayer | None:
        """Return a replayer of the native FMU of the model's class, in which parameter values are set."""
        fmu = place.folder / f"class{self.substeps(self.rate)}.fmu"
        if not fmu.is_file():
            class_fmu(self.loaded, fmu)
        return FmuReplayer(self.model, fmu, place, "native", dict(self.loaded.parameters))  # a worker pickles it

    def write(self, scratch: Path, folder: Path, name: str) -> Sequence[Path]:
        """Write model.yaml and plant.fmu, or nearest.yaml and nearest.fmu."""
        yaml, fmu = (scratch / file for file in DELIVERED_FILES[name])
        write_model(yaml, self.loaded, folder)
        return yaml, Path(copyfile(self._built(scratch), fmu))

    def use(self, folder: Path, name: Literal["refined", "nearest"] = "refined") -> list[str]:
        """Return a command line for the FMU."""
        return ["cosim", "simulate", str(folder / DELIVERED_FILES[name][1])]


def new_fmu(folder: Path) -> Path:
    """Return the path for a new FMU in a folder."""
    return folder / f"replayed{len([*folder.glob('replayed*.fmu')])}.fmu"


def neutral_values(model: Model) -> dict[str, float]:
    """Return name → value of all parameters of the filter, which are numbers, not Booleans.

    Effects and sensor errors that the model lacks have their neutral values, at which they have no effect.
    """
    own = {p.name: getattr(model, p.name) for p in model.parameters}
    own |= {f"{e.name}.{p.name}": getattr(e, p.name) for e in model.effects for p in parameters_of(e)}
    declared = model.declared | model.sensor_parameters
    switches = {p.name for p in model.parameters if isinstance(p.default, bool)}
    return {name: float(own.get(name, p.default)) for name, p in declared.items() if name not in switches}


@dataclass
class FmuReplayer(Replayer):
    """Replays of logs through a model's FMU, in a worker process.

    Attributes:
        parameters: Parameter values to set in the FMU if they differ from its defaults.
    """

    model: Model
    fmu: Path
    place: Workplace
    through: str
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def replays(
        self, log: Log, data: Data, values: NamedValues, starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield one replay for each horizon, for which the FMU is loaded once."""
        limits, interpolated = self.place.limits, data.interpolated
        with drive_in(self.place.worker, log, self.fmu, limits=limits, interpolated=interpolated) as drive:
            for horizon, begins in starts.items():
                numbers = {k: {**self.parameters, **start_values(self.model, start)} for k, start in begins.items()}
                memories = {k: delayed_commands(self.model, values, log, data, k) for k in begins}
                yield windows(drive, numbers, horizon, memories)


def start_values(model: Model, start: Start) -> dict[str, float]:
    """Return the FMU's start parameters for a replay.

    The memory of delays, and sensor errors, are left out.
    """
    awake, plant = {e.name for e in model.awake}, model.declared
    values = {name: value for name, value in start.per_log.items() if name in plant}
    for name, value in start.states.items():
        if "." not in name or name.split(".")[0] in awake:
            values[f"{name}_start"] = value
    # for the memory of a delay see `delayed_commands`
    places = [(e.name, q.name) for e in shaping_effects(model.catalogue) if not e.delay for q in e.memory]
    for (name, memory), value in zip(places, start.memory, strict=False):
        if name in awake:
            values[f"{name}.{memory}_start"] = float(value)
    return values


@cache
def shaping_effects(catalogue: tuple[type[Effect], ...]) -> tuple[Any, ...]:
    """Return the effects of a catalogue that shape the command, in order."""
    return tuple(overrides(tuple(kind() for kind in catalogue), "shape", Effect))


def delayed_commands(model: Model, values: NamedValues, log: Log, data: Data, k: int) -> Memory:
    """Return the commands that are still in a delay at row k, as (start time, command), oldest first."""
    shaping = overrides(model.awake, "shape", Effect)
    waiting: dict[tuple[int, int], Any] = {}
    for place, shaper in enumerate(shaping):
        if shaper.delay:
            row = int(log.grid[k])
            late = values[f"{shaper.name}.{shaper.delay}"] / data.step
            rows = range(max(0, math.floor(row - late)), row) or [row]
            waiting[MEMORY, place] = [[float(log.time[k]) - (row - j) * data.step, data.u[j].tolist()] for j in rows]
    return waiting
