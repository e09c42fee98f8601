"""FMUs as subjects of refinement: terms of the general catalogue are added to the FMU's equations.

In model exchange, the filter calls the FMU for derivatives. In co-simulation, the FMU is simulated over the whole log,
and the filter estimates the deviations of its outputs.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np

from cosim.core.arrays import Array, NamedValues
from cosim.core.errors import InputError
from cosim.core.units import unit_of_rate, unit_product
from cosim.estimation.kernel.backend import kernel
from cosim.estimation.kernel.kernel import DISTURBANCE, START_PREFIX, Begin, Data, Kernel, simulate_all
from cosim.estimation.kernel.library_kernel import NO_LIMITS, LibraryOf
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Predict, Replayer, Start, Workplace
from cosim.estimation.subject.model_subject import DELIVERED_FILES, ModelSubject, new_fmu
from cosim.fmi.building.file import LoadedModel
from cosim.fmi.description import display_units, read_description, takes_any_step
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.wrapping.wrap import CannotWrap, wrap
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.logs.log import Log
from cosim.model.quantities import Parameter, Quantity, parameters_of
from cosim.model.traits import Traits
from cosim.probing.fmu_structure import StartValue, Structure
from cosim.residuals.drive import REPLAY_MODULES, DriveApart
from cosim.residuals.windows import Replay, start_parameters
from cosim.terms.catalogue import bound_terms, delay_of, experiments_for, sensor_errors
from cosim.terms.code import FmuModel, fmu_model, term_code
from cosim.terms.language import Direction, Force, Opposite, Place, with_place

SUBSTEPS = 8  # steps of co-simulation between rows, for forces that follow the outputs
WAY_DESCRIPTIONS = {
    "model-exchange": "model exchange: a filter over the states of the FMU",
    "co-simulation": "co-simulation: simulations of whole logs, with estimated deviations of the outputs",
}
NO_ACCESS = (
    "effects inside the FMU, away from its inputs and outputs (co-simulation gives no access; "
    "an FMU for model exchange does)"
)


class FmuSubject(ModelSubject):
    """An FMU with the terms that it may lack.

    Attributes:
        structure: Structure of the FMU, found by simulation along the logs.
        limits: Limits of time and memory for a pass of the filter over a log.
    """

    model: FmuModel
    probed = True

    def __init__(self, loaded: LoadedModel, structure: Structure, limits: Limits = NO_LIMITS) -> None:
        super().__init__(loaded)
        self.structure, self.limits = structure, limits
        self.is_stepped = structure.way == "co-simulation"
        self.untried = NO_ACCESS if self.is_stepped else ""
        self.source = f"{structure.fmu}, {WAY_DESCRIPTIONS[structure.way]}"
        self._description = read_description(structure.fmu)
        self.display = display_units([self._description])
        names = (kind.name for kind in (*self.model.catalogue, *self.model.sensors))
        self.told_apart_by = {**self.model.told_apart_by, **experiments_for(names)}
        self.start_variance = {START_PREFIX + with_place(s.name): s.size**2 for s in structure.starts}

    @classmethod
    def of_fmu(
        cls,
        structure: Structure,
        logs: Sequence[Log],
        terms: Sequence[type[Any]] = (),
        limits: Limits = NO_LIMITS,
    ) -> FmuSubject:
        """Return the subject of a probed FMU.

        Args:
            logs: Estimation logs, which determine the usual sizes of signals.
            terms: Terms that the user has added to the catalogue.
        """
        if structure.way == "co-simulation":
            with Worker(*REPLAY_MODULES) as worker, DriveApart(worker, logs[0], structure.fmu) as drive:
                shown = start_parameters(drive)
            # parameters for start values are not parameters of fits
            known, variables = {s.shown for s in structure.starts}, {p.name: p.quantity for p in structure.parameters}
            more = []
            for k, output in enumerate(structure.outputs):
                start = shown.get(output.name)
                if start is not None and k not in known and start.name in variables:
                    size = (structure.scales.get(output.name) or 1.0) / abs(start.gain)
                    more.append(StartValue(variables[start.name], size, k, start.gain))
            names = {p.name for p in shown.values()}
            left = tuple(p for p in structure.parameters if p.name not in names)
            structure = replace(structure, starts=(*structure.starts, *more), parameters=left)
        return cls(LoadedModel(probed_model(structure, logs, terms), str(structure.fmu)), structure, limits)

    @property
    def names(self) -> dict[str, str]:
        """Return variable of the FMU → name in the model."""
        return {variable: name for name, variable in self.model.variables.items()}

    @property
    def traits(self) -> Traits:
        """Return the signal properties, with output derivatives from the structure of the FMU."""
        outputs = {**{q.name: q.name for q in self.structure.outputs}, **self.structure.shown}
        pairs = [p for p in self.structure.pairs if p.gain == 1.0 and {p.position, p.velocity} <= outputs.keys()]
        return Traits.of(self.model, {with_place(outputs[p.position]): with_place(outputs[p.velocity]) for p in pairs})

    @property
    def measured_states(self) -> frozenset[str]:
        """Return the names of the states that are measured. A measured state has the name of its output."""
        if self.is_stepped:
            return frozenset(with_place(q.name) for q in self.structure.outputs)
        return frozenset(map(with_place, self.structure.shown.values()))

    def candidates(self, varied: Sequence[str]) -> list[Candidate]:
        """Return terms, sensor errors and parameters as candidates; a periodic force has its period in `repeats`."""
        states, catalogue = self.model.base_states, self.model.catalogue
        forces = [kind for kind in catalogue if issubclass(kind, Force) and kind.repeats]
        periods = {kind.name: (f"{kind.name}.{kind.repeats}", states[kind.place.position].name) for kind in forces}
        return [replace(c, repeats=periods.get(c.name, ())) for c in super().candidates(varied)]

    def kernel(self, measured: Sequence[str], *, unnamed: bool = False, constant: Sequence[str] = ()) -> Kernel:
        """Return the filter with the FMU's library.

        Raises:
            InputError: `constant` is not empty, which an FMU does not support, or there is no compiler.
        """
        if constant:
            raise InputError.at(
                self.structure.fmu,
                f"{', '.join(constant)} cannot be estimated per log, because an FMU accepts parameters only before its "
                "initialization; remove per_log",
            )
        return kernel(self.model, measured, unnamed, fmu=self._library_of(self.structure.fmu, self._description))

    def _library_of(self, fmu: Path, description: Any) -> LibraryOf:
        """Return the FMU for a kernel, with usual sizes of states and with start parameters."""
        sizes = [self.structure.scales.get(q.name, 0.0) for q in self.structure.states]
        starts = tuple((s.name, s.size) for s in self.structure.starts)
        model = self.model
        turned = [k for k in model.catalogue if issubclass(k, Force) and k.place.direction is not None]
        neutral = {f"{k.name}.{p.name}": p.neutral for k in turned for p in parameters_of(k) if p.neutral is not None}
        about = fmu, description, dict(model.variables), sizes
        return LibraryOf(*about, starts, self.values, self.limits, model.directions, neutral)

    def start(self) -> dict[str, float]:
        """Return the start value of each state."""
        own = {START_PREFIX + with_place(s.name): s.quantity.start for s in self.structure.starts}
        return {q.name: q.start for q in self.states} | own

    def start_of_log(self, readings: NamedValues) -> dict[str, float]:
        """Return the start value of each state in a log; for start states, from the output that shows them."""
        start, outputs = self.start(), self.outputs
        for s in self.structure.starts:
            if s.gain and (name := outputs[s.shown].name) in readings:
                low, high = s.quantity.bounds
                value = s.quantity.start + (readings[name] - outputs[s.shown].start) / s.gain
                start[START_PREFIX + with_place(s.name)] = min(max(value, low), high)
        return {**start, **readings}

    def substeps(self, step: float) -> int:
        """Return the number of integration steps, or of co-simulation steps, between rows."""
        if not self.is_stepped:
            return super().substeps(step)
        return SUBSTEPS if self.structure.pairs and takes_any_step(self._description) else 1

    def prediction(self, log: Log) -> Predict | None:
        """Return None: outliers are detected by comparison with neighbouring readings."""
        return None

    def refined(self, claims: NamedValues) -> FmuSubject:
        """Return the subject with claimed values."""
        return FmuSubject(super().refined(claims).loaded, self.structure, self.limits)

    def replayer(self, place: Workplace) -> Replayer:
        """Return a replayer of the delivered FMU, or of the model (FMU and terms) if the FMU cannot be built."""
        delivered = self._replayed(place.folder)
        outputs = [q.name for q in self.outputs]
        if delivered is None:
            return LibraryReplayer(self, self.kernel(outputs), "own")
        # The delivered FMU already contains terms and values.
        model = self.model
        kept = {"dependencies", "rates", "variables", "shown", "stepped", "starts", "substep", "integrator"}
        attributes = {name: getattr(type(model), name) for name in kept}
        plain = fmu_model(model.title, (model.base_states, model.inputs, model.outputs), (), (), **attributes)
        of_fmu = self._library_of(delivered, read_description(delivered))
        return LibraryReplayer(self, kernel(plain, outputs, fmu=of_fmu), "native")

    def quick_replayer(self, place: Workplace) -> LibraryReplayer | None:
        """Return a replayer that uses the kernel."""
        if self._replayed(place.folder) is None:
            return None
        return LibraryReplayer(self, self.kernel([q.name for q in self.outputs]), "own")

    def _replayed(self, folder: Path) -> Path | None:
        """Return the delivered FMU if its replays can begin at the same rows as those of the model, else None."""
        has_memory = not self.is_stepped and any(e.memory or e.delay for e in self.model.awake)
        return None if has_memory else self._delivered(folder)

    def _delivered(self, folder: Path) -> Path | None:
        """Return the FMU with terms, built once; None if this fails, with the reason in `undelivered`."""
        if self.undelivered or (self.fmu is not None and self.fmu.is_file()):
            return None if self.undelivered else self.fmu
        model, own = self.model, {p.name for p in self.parameters}
        signals = self.structure.outputs if self.is_stepped else self.structure.states
        code = term_code(model, [e.name for e in model.awake], [q.name for q in signals])
        values = {model.variables[n] if n in own else n: float(v) for n, v in self.loaded.parameters.items()}
        known = {*(p.name for p in code.parameters), *model.variables.values()}
        path, kept = new_fmu(folder), {n: v for n, v in values.items() if n in known}
        try:
            left_out = wrap(self.structure.fmu, code, kept, path, substep=self.rate / self.substeps(self.rate))
        except (CannotWrap, NoCompiler, CompilerFailed) as error:
            self.undelivered = f"There is no refined FMU: {error}"
            return None
        self.fmu, self.missing_platforms = path, tuple(left_out)
        return path

    def write(self, scratch: Path, folder: Path, name: str) -> Sequence[Path]:
        """Write plant.fmu or nearest.fmu: the original FMU with the claimed terms and values."""
        fmu = self._delivered(scratch)
        return () if fmu is None else (Path(copyfile(fmu, scratch / DELIVERED_FILES[name][1])),)


@dataclass
class LibraryReplayer(Replayer):
    """Replays of logs by the kernel of a subject."""

    subject: FmuSubject
    kernel: Kernel
    through: str

    def replays(
        self, log: Log, data: Data, values: NamedValues, starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield one replay for each horizon."""
        names = [q.name for q in self.subject.outputs]
        layout, grid = self.kernel.layout, np.asarray(log.grid, np.intp)
        clean = {n: float(p.default) for n, p in self.subject.sensor_parameters.items()}
        given = {**self.subject.values, **values, **clean}
        p = np.array([given.get(n, 1.0) for n in layout.parameters])
        for horizon, begins in starts.items():
            table = np.full((log.rows, len(names)), np.nan)
            # replays of a co-simulation FMU begin only at the start of a log
            rows = [] if self.subject.is_stepped and math.isfinite(horizon) else sorted(begins)
            ends, runs = [*rows[1:], len(grid) - 1], list[Begin]()
            for k, last in zip(rows, ends, strict=False):
                state = begins[k].states
                known = [0.0 if n.startswith(DISTURBANCE) else state.get(n, 0.0) for n in layout.states]
                memory = np.asarray(begins[k].memory, float)[: layout.memory]
                runs.append((data.rows(0, int(grid[last]) + 1), p, np.array(known), memory, None, int(grid[k])))
            for k, last, run in zip(rows, ends, simulate_all(self.kernel, runs), strict=False):
                table[k + 1 : last + 1] = run.outputs[grid[k + 1 : last + 1]]
            begun = {k: {n: v for n, v in start.states.items() if "." not in n} for k, start in begins.items()}
            yield Replay(horizon, begun, dict(zip(names, table.T, strict=True)))


# The model of a probed FMU: signals, places with usual sizes in the logs, terms and parameters.


HORIZON_ROWS, HORIZON_SHARE = 50, 0.1  # duration of replays: least in rows, and usual share of a log
LATEST = 20  # longest delay of the inputs, in rows
SLOPE_ROWS = 5  # rows over which the rate of readings is taken
UNBOUNDED_FACTOR = 100.0  # factor on a parameter without bounds, up and down
RESOLVED = 0.25  # substep times largest eigenvalue; transition of friction of half the usual force, in steps


def probed_model(structure: Structure, logs: Sequence[Log], terms: Sequence[type[Any]] = ()) -> FmuModel:
    """Return the model of a probed FMU with every term at every place.

    Args:
        logs: Estimation logs, with names of FMU variables.
        terms: Terms that the user has added to the catalogue.
    """
    s, step, is_stepped = structure, logs[0].step, structure.way == "co-simulation"
    states = s.outputs if is_stepped else s.states
    duration = max(float(log.time[-1] - log.time[0]) for log in logs)
    outputs = [q.name for q in s.outputs]
    inputs, named_outputs = (
        tuple(replace(q, name=with_place(q.name)) for q in group) for group in (s.inputs, s.outputs)
    )
    # a state that an output shows has the name of the output
    named = tuple(replace(q, name=with_place(s.shown_as(q.name))) for q in states)
    names = [q.name for q in states]
    rates = {names.index(p.position): names.index(p.velocity) for p in s.pairs if p.gain == 1.0}
    parameters = []
    for p in s.acting:  # a parameter without bounds keeps its sign; the usual size of a value 0 is the tried change
        q, (low, high) = p.quantity, p.quantity.bounds
        if q.start != 0.0:
            ends = sorted((q.start / UNBOUNDED_FACTOR, q.start * UNBOUNDED_FACTOR))
            low, high = max(low, ends[0]), min(high, ends[1])
        typical = abs(p.tried) if q.start == 0.0 else None
        parameters.append(Parameter(with_place(q.name), q.start, q.unit, q.doc, (low, high), typical=typical))
    moving = tuple(with_place(name) for name in (q.name for q in s.inputs) if any(map(np.ptp, _columns(logs, name))))
    sensors: list[type[Any]] = []
    for q, name in zip(named_outputs, outputs, strict=True):
        signed = any(float(np.nanmin(y)) < 0.0 for y in _columns(logs, name))
        sensors += sensor_errors(q, _size(s, logs, name), step, duration, signed=signed)
    delay = [delay_of(inputs, LATEST * step)] if inputs else []
    return fmu_model(
        s.fmu.stem,
        (named, inputs, named_outputs),
        parameters,
        [*delay, *bound_terms([*_places(s, logs, states)], terms)],
        dependencies=s.depends,
        rates=rates,
        variables={
            with_place(q.name): q.name for q in (*s.states, *s.inputs, *s.outputs, *(p.quantity for p in s.acting))
        },
        sensors=tuple(sensors),
        forced=tuple(q.name for k, q in enumerate(named) if is_stepped or k not in rates),
        calibrated=tuple(p.name for p in parameters),
        suspect=dict.fromkeys((p.name for p in parameters), moving),
        horizon=math.inf if is_stepped else float(f"{max(HORIZON_ROWS * step, HORIZON_SHARE * duration):.2g}"),
        shown={outputs.index(y): k for k, q in enumerate(s.states) if (y := s.shown.get(q.name))},
        stepped=is_stepped,
        starts=tuple(with_place(v.name) for v in s.starts),
        rate=step,
        substep=min(step, RESOLVED / s.largest_rate if s.largest_rate > 0.0 else math.inf),
        integrator="rk4",
    )


def _columns(logs: Sequence[Log], name: str) -> list[Array]:
    """Return an input or output of each log that contains it."""
    signals = [{**log.inputs, **log.outputs} for log in logs]
    return [columns[name] for columns in signals if name in columns]


def _size(s: Structure, logs: Sequence[Log], name: str) -> float:
    """Return the usual size of a signal: its standard deviation.

    For an input, it is half of its range within a log, otherwise over all logs, otherwise its value; 1 for a constant
    0.
    """
    columns = _columns(logs, name)
    if all(q.name != name for q in s.inputs) or not columns:
        return s.scales.get(name) or 1.0
    every = np.concatenate(columns)
    return 0.5 * max(map(np.ptp, columns)) or 0.5 * float(np.ptp(every)) or float(np.abs(every).max()) or 1.0


def _places(s: Structure, logs: Sequence[Log], states: Sequence[Quantity]) -> Iterator[Place]:
    """Yield every place of terms, with usual sizes along the logs.

    Args:
        states: The states; for co-simulation, the outputs.
    """
    step, names, inputs = logs[0].step, [q.name for q in states], [q.name for q in s.inputs]
    units = {q.name: q.unit for group in (s.states, s.inputs, s.outputs) for q in group}
    size = partial(_size, s, logs)

    def rate(name: str) -> float:
        """Return the usual rate of change of a signal."""
        changes = [y[SLOPE_ROWS:] - y[:-SLOPE_ROWS] for y in _columns(logs, name)]
        read = max((float(np.nanstd(change)) for change in changes), default=0.0)
        return s.scales.get(f"der({name})") or read / (SLOPE_ROWS * step) or 1.0

    for k, q in enumerate(s.inputs):
        usual = size(q.name)
        largest = max((float(np.abs(u).max()) for u in _columns(logs, q.name)), default=0.0) or usual
        sizes = {"u": usual, "M": largest, "T": step}
        yield Place(with_place(q.name), {"u": q.unit, "M": q.unit, "T": "s"}, sizes, k)
    # A force on a velocity acts through an input, or changes several derivatives (found by a damping parameter), or
    # one.
    for pair in s.pairs:
        port = next((p for p in (*(p for p in pair.ports if p.is_alone), *pair.ports)), None)
        damping = next((d for d in s.dampings if d.pair == pair), None)
        if damping is not None and damping.port:
            port = next((p for p in pair.ports if p.input == damping.port), port)
        elif damping is not None and (damping.is_constant or damping.in_step):
            port = None
        if s.way == "co-simulation" and port is None:
            continue
        v, x, fastest = pair.velocity, pair.position, rate(pair.velocity)
        own = {"u": unit_of_rate(units[v]), "v": units[v], "q": units[x], "d": units[x]}
        travel = math.sqrt(12.0) * size(x)  # range of a uniformly distributed position
        sizes = {"u": fastest, "v": size(v), "q": size(x), "d": travel}
        ends = names.index(x), names.index(v)
        place = Place(with_place(v), own, sizes, -1, *ends, resolution=RESOLVED * fastest * step)
        if damping is not None and damping in s.directions and damping.in_step:
            quantity = next(p.quantity for p in s.parameters if p.name == damping.parameter)
            rates, number = tuple(map(names.index, damping.rates)), s.directions.index(damping)
            limits = damping.change, quantity.bounds[1]
            direction = Direction(number, damping.parameter, *limits, names.index(v), damping.speed, rates)
            own["u"] = unit_product([(units[v], 1), (quantity.unit, 1)])
            sizes["u"] = fastest / damping.gain
            place = replace(place, direction=direction, is_driven=bool(pair.ports))
        elif port is not None:
            own["u"], sizes["u"] = units[port.input], fastest / abs(port.gain)
            place = replace(place, input=inputs.index(port.input), sign=math.copysign(1.0, port.gain))
        yield place
    for c in s.connections:  # forces in connections, in units of the first end's acceleration
        x, v = c.first.position, c.first.velocity
        own = {"u": unit_of_rate(units[v]), "v": units[v], "q": units[x]}
        deflection, speed = c.deflection or size(x), c.speed or size(v)
        sizes = {"u": c.stiffness * deflection or c.damping * speed, "v": speed, "q": deflection}
        if c.stiffness:
            own["k"], sizes["k"] = unit_product([(own["u"], 1), (own["q"], -1)]), c.stiffness
        factors = tuple(replace(f, parameter=with_place(f.parameter)) for f in c.factors)
        other = Opposite(names.index(c.second.position), names.index(c.second.velocity), c.gear, c.ratio, factors)
        name = f"{with_place(v)}_against_{with_place(c.second.velocity)}"
        ends = names.index(x), names.index(v)
        yield Place(name, own, sizes, -1, *ends, resolution=RESOLVED * rate(v) * step, opposite=other)
    for name in s.storages:
        index, columns = names.index(name), _columns(logs, s.shown_as(name))
        middle = float(np.nanmean(np.concatenate(columns))) if columns else states[index].start
        sizes = {"q": size(name), "r": rate(name)}
        own = {"q": units[name], "r": unit_of_rate(units[name])}
        place = Place(with_place(name), own, sizes, state=index, middle=middle)
        feed = s.feeds.get(name)
        yield replace(place, input=inputs.index(feed.input), gain=feed.gain) if feed else place
