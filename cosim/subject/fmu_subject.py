"""FMUs as subjects: terms of the general catalogue are added to what the FMU's library computes.

In model exchange a filter evaluates the derivatives of the library. In co-simulation the library runs freely, and the
filter estimates an addition to each of its outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copyfile
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import InputError
from cosim.base.units import unit_product
from cosim.blocks.description import read_description, takes_any_step, ways
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.isolation.process import Worker
from cosim.kernel.backend import kernel
from cosim.kernel.kernel import DISTURBANCE, Data, Kernel
from cosim.kernel.library_kernel import LibraryOf
from cosim.kernel.messages import NO_CONSTANTS
from cosim.loading.file import LoadedModel
from cosim.logs.log import Log
from cosim.model.model import Model
from cosim.model.quantities import Parameter, Quantity
from cosim.probing.fmu_structure import Structure
from cosim.probing.probe_structure import probe_structure
from cosim.residuals.remote_drive import MODULES, DriveApart
from cosim.residuals.starts import StartParameter, start_parameters
from cosim.residuals.windows import Replay
from cosim.subject.interface import Predict, Replayer, Start, Workplace
from cosim.subject.model_subject import FILES, ModelSubject
from cosim.subject.start_state import start_state
from cosim.terms.catalogue import Stribeck, bound_terms, delay_of, sensor_errors
from cosim.terms.fmu_model import Dependencies, FmuModel, fmu_model
from cosim.terms.language import Place, with_place
from cosim.terms.printed import term_code
from cosim.wrapping.wrap import CannotWrap, wrap

STIFFEST = 20.0  # step times largest eigenvalue, above which explicit integration from row to row is too costly
FINEST = 0.25  # substep times largest eigenvalue; a fit takes the coarsest with equal likelihood
SUBSTEPS = 32  # steps of co-simulation between rows, for forces that follow the outputs
WAYS = {
    "model-exchange": "model exchange: a filter over the states of the FMU",
    "co-simulation": "co-simulation: free runs of the FMU, with an estimated addition to each output",
}
HORIZON_ROWS, HORIZON_SHARE = 50, 0.1  # duration of replays: least in rows, and usual share of a log
SLOPE_ROWS = 5  # rows over which the rate of readings is taken
LATEST = 20  # longest delay of the inputs, in rows
WIDEST = 100.0  # factor on a parameter without bounds, up and down


class FmuSubject(ModelSubject):
    """An FMU with the terms that it may lack.

    Attributes:
        structure: Structure of the FMU along the logs.
        starts: Output → start parameter, for free runs.
    """

    def __init__(
        self, loaded: LoadedModel, structure: Structure, starts: Mapping[str, StartParameter] = MappingProxyType({})
    ) -> None:
        super().__init__(loaded)
        self.starts = starts
        self.structure = structure
        self.is_stepped = structure.way == "co-simulation"
        self.source = f"{structure.fmu}, {WAYS[structure.way]}"
        self._description = read_description(structure.fmu)

    @classmethod
    def of_fmu(cls, structure: Structure, logs: Sequence[Log], terms: Sequence[type[Any]] = ()) -> FmuSubject:
        """Return the subject of a probed FMU.

        Args:
            logs: Estimation logs, for usual sizes.
            terms: Terms of the user.
        """
        model = _model(structure, logs, terms)
        loaded = LoadedModel(model, str(structure.fmu))
        if structure.way == "model-exchange":
            return cls(loaded, structure)
        with Worker(*MODULES) as worker, DriveApart(worker, logs[0], structure.fmu) as drive:
            return cls(loaded, structure, start_parameters(drive))

    @property
    def names(self) -> dict[str, str]:
        """Return variable of the FMU → name in the model."""
        variables: Mapping[str, str] = self.model.variables  # type: ignore[attr-defined]
        return {variable: name for name, variable in variables.items()}

    @property
    def measured_states(self) -> frozenset[str]:
        """Return the states that an output shows; the model gives them its name."""
        if self.is_stepped:
            return frozenset(map(with_place, self.starts))
        return frozenset(map(with_place, self.structure.shown.values()))

    def kernel(self, measured: Sequence[str], *, unnamed: bool = False, constant: Sequence[str] = ()) -> Kernel:
        """Return the filter with the FMU's library.

        Raises:
            InputError: Parameters as constant states, which a library cannot have, or no compiler.
        """
        if constant:
            raise InputError.at(self.structure.fmu, NO_CONSTANTS(names=", ".join(constant)))
        return kernel(self.model, measured, unnamed, fmu=self._library_of(self.structure.fmu, self._description))

    def _library_of(self, fmu: Path, description: Any) -> LibraryOf:
        """Return an FMU for a kernel, with the usual sizes and the start parameters."""
        sizes = [self.structure.scales.get(q.name, 0.0) for q in self.structure.states]
        starts = [(k, self.starts[q.name]) for k, q in enumerate(self.structure.outputs) if q.name in self.starts]
        return LibraryOf(fmu, description, sizes, tuple((k, p.name, 1.0 / p.gain) for k, p in starts))

    def start(self) -> dict[str, float]:
        """Return the start value of each state."""
        return {q.name: q.start for q in self.states}

    def substeps(self, step: float) -> int:
        """Return the number of integration steps, or of steps of co-simulation, between rows."""
        if not self.is_stepped:
            return super().substeps(step)
        return SUBSTEPS if self.structure.pairs and takes_any_step(self._description) else 1

    def settling(self, states: Sequence[str]) -> float:
        """Return 0: every state that is not exactly the integral of another one has process noise."""
        return 0.0

    def prediction(self, log: Log) -> Predict | None:
        """Return None: outliers are found by their neighbours."""
        return None

    def nameless(self, signal: str) -> tuple[Callable[..., Any], Sequence[str]] | None:
        """Return a basis function of the kernel's unnamed terms."""
        return super().nameless(signal)

    def refined(self, claims: Mapping[str, float]) -> FmuSubject:
        """Return the subject with claimed values."""
        return FmuSubject(super().refined(claims).loaded, self.structure, self.starts)

    def replayer(self, place: Workplace) -> LibraryReplayer:
        """Return a replayer of the delivered FMU, or of the model if no FMU can stand for it."""
        if not self._can_begin_anywhere:
            return LibraryReplayer(self, self.kernel([q.name for q in self.outputs]), "own")
        delivered = self._delivered(place.folder)
        if delivered is None:
            return LibraryReplayer(self, self.kernel([q.name for q in self.outputs]), "own")
        return LibraryReplayer(self, self._kernel_of(delivered), "native")

    def quick_replayer(self, place: Workplace) -> LibraryReplayer | None:
        """Return a replayer of the model."""
        if not self._can_begin_anywhere or self._delivered(place.folder) is None:
            return None
        return LibraryReplayer(self, self.kernel([q.name for q in self.outputs]), "own")

    @property
    def _can_begin_anywhere(self) -> bool:
        """Return True if a replay through the delivered FMU begins wherever one of the model does."""
        return self.is_stepped or not any(e.memory or e.delay for e in self.model.awake)

    def _delivered(self, folder: Path) -> Path | None:
        """Return the FMU with the terms, built once; None if it cannot be built, with the reason in `undelivered`."""
        if self.fmu is None or not self.fmu.is_file():
            path = folder / f"replayed{len([*folder.glob('replayed*.fmu')])}.fmu"
            model, own = self.model, {p.name for p in self.parameters}
            assert isinstance(model, FmuModel)
            signals = self.structure.outputs if self.is_stepped else self.structure.states
            code = term_code(model, [e.name for e in model.awake], [q.name for q in signals])
            values = {model.variables[n] if n in own else n: float(v) for n, v in self.loaded.parameters.items()}
            known = {*(p.name for p in code.parameters), *model.variables.values()}
            substep = self.rate / self.substeps(self.rate)
            try:
                wrap(self.structure.fmu, code, {n: v for n, v in values.items() if n in known}, path, substep=substep)
            except (CannotWrap, NoCompiler, CompilerFailed) as error:
                self.undelivered = str(error)
                return None
            self.fmu = path
        return self.fmu

    def _kernel_of(self, fmu: Path) -> Kernel:
        """Return the kernel of a delivered FMU, which holds terms and values itself."""
        model = self.model
        assert isinstance(model, FmuModel)
        kept = {"dependencies", "rates", "variables", "stepped", "substep", "integrator"}
        attributes = {name: getattr(type(model), name) for name in kept}
        plain = fmu_model(model.title, (model.base_states, model.inputs, model.outputs), (), (), **attributes)
        of_fmu = self._library_of(fmu, read_description(fmu))
        return kernel(plain, [q.name for q in self.outputs], fmu=of_fmu)

    def write(self, scratch: Path, folder: Path, name: str) -> Sequence[Path]:
        """Write plant.fmu or nearest.fmu: the original with the terms and values."""
        fmu = self._delivered(scratch)
        return () if fmu is None else (Path(copyfile(fmu, scratch / FILES[name][1])),)

    def use(self, folder: Path) -> list[str]:
        """Return a command line that simulates the delivered FMU."""
        return ["cosim", "simulate", str((folder / FILES["refined"][1]).resolve())]


@dataclass
class LibraryReplayer(Replayer):
    """Replays by the kernel of a subject."""

    subject: FmuSubject
    kernel: Kernel
    through: str

    def replays(
        self, log: Log, data: Data, values: Mapping[str, float], starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield one replay for each horizon."""
        units = {q.name: q.unit for q in self.subject.outputs}
        kernel = self.kernel
        layout, grid = kernel.layout, np.asarray(log.grid, np.intp)
        clean = {n: float(p.default) for n, p in self.subject.sensor_parameters.items()}
        given = {**self.subject.values, **values, **clean}
        p = np.array([given.get(n, 1.0) for n in layout.parameters])
        for horizon, begins in starts.items():
            table, rows = np.full((log.rows, len(units)), np.nan), sorted(begins)
            if not self.subject.is_stepped:
                for k, last in zip(rows, [*rows[1:], log.rows - 1], strict=False):
                    known = [0.0 if n.startswith(DISTURBANCE) else begins[k].states.get(n, 0.0) for n in layout.states]
                    memory = np.asarray(begins[k].memory, float)[: layout.memory]
                    part = data.rows(0, int(grid[last]) + 1), p, np.array(known), memory
                    table[k + 1 : last + 1] = kernel.simulate(*part, first=int(grid[k])).outputs[grid[k + 1 : last + 1]]
            elif math.isinf(horizon):  # a library begins at the start of a log only
                x0 = start_state(self.subject, replace(data, y=_readings(log, units, grid)), [*units], layout.states)
                run = kernel.simulate(data, p, x0, np.zeros(layout.memory))
                table[rows[0] + 1 :] = run.outputs[grid[rows[0] + 1 :]]
            begun = {k: {n: v for n, v in start.states.items() if "." not in n} for k, start in begins.items()}
            yield Replay(log.time, horizon, begun, dict(zip(units, table.T, strict=True)), units)


def _readings(log: Log, names: Iterable[str], grid: Rows) -> Array:
    """Return the readings of outputs in equal steps, NaN without one."""
    table = np.full((int(grid[-1]) + 1, len([*names])), np.nan)
    for j, name in enumerate(names):
        table[grid, j] = log.outputs.get(name, np.nan)
    return table


def _model(structure: Structure, logs: Sequence[Log], terms: Sequence[type[Any]]) -> Model:
    """Return the model of a probed FMU."""
    own, stepped = _names(structure), structure.way == "co-simulation"
    states, inputs, outputs = (
        [replace(q, name=own.get(q.name, with_place(q.name)) if is_state else with_place(q.name)) for q in group]
        for group, is_state in ((structure.states, True), (structure.inputs, False), (structure.outputs, False))
    )
    step, duration = logs[0].step, max(float(log.time[-1] - log.time[0]) for log in logs)
    ranges = {q.name: max(float(np.ptp(log.inputs[q.name])) for log in logs) for q in inputs}
    sizes = {with_place(n): v for n, v in structure.scales.items()}
    parameters = [_parameter(p.quantity) for p in structure.acting]
    positions = {p.position: p.velocity for p in structure.pairs if p.gain == 1.0}
    index = {q.name: k for k, q in enumerate(structure.states)}
    states = outputs if stepped else states
    readings: dict[str, list[Array]] = {}
    for log in logs:
        for n, y in log.outputs.items():
            readings.setdefault(n, []).append(y)
    means = {n: float(np.nanmean(np.concatenate(parts))) for n, parts in readings.items()}
    rates = {
        n: max(float(np.nanstd(y[SLOPE_ROWS:] - y[:-SLOPE_ROWS])) for y in parts) / (SLOPE_ROWS * step)
        for n, parts in readings.items()
    }
    places = [*_places(structure, sizes | ranges, step, means, rates)]
    varied = tuple(n for n, width in ranges.items() if width > 0.0)
    # a force held over a substep is too coarse for the shape of friction near rest
    bound = [t for t in bound_terms(places, terms) if not (stepped and issubclass(t, Stribeck))]
    catalogue = (*([delay_of(inputs, LATEST * step)] if inputs else ()), *bound)
    horizon = math.inf if structure.way == "co-simulation" else max(HORIZON_ROWS * step, HORIZON_SHARE * duration)
    sensors = [error for q in outputs for error in sensor_errors(q, sizes.get(q.name) or 1.0, step, duration)]
    return fmu_model(
        structure.fmu.stem,
        (states, inputs, outputs),
        parameters,
        catalogue,
        dependencies=Dependencies(
            np.vstack([structure.state_in_rate, structure.state_in_output]),
            np.vstack([structure.input_in_rate, structure.input_in_output]),
        ),
        rates={} if stepped else {index[q]: index[v] for q, v in positions.items()},
        variables={with_place(q.name): q.name for q in (*structure.states, *structure.inputs, *structure.outputs)}
        | {with_place(p.name): p.name for p in structure.acting},
        sensors=tuple(sensors),
        forced=tuple(own[q.name] for q in structure.states if q.name not in positions),
        calibrated=tuple(p.name for p in parameters),
        suspect={p.name: varied for p in parameters},
        horizon=float(f"{horizon:.2g}"),
        stepped=structure.way == "co-simulation",
        rate=step,
        substep=min(step, FINEST / structure.largest_rate) if structure.largest_rate > 0.0 else step,
        integrator="rk4",
    )


def probe_best(fmu: Path, logs: Sequence[Log]) -> Structure:
    """Return the structure for the better interface of an FMU.

    Model exchange is better, unless events or a fast state make its derivatives unusable from row to row.
    """
    structure = probe_structure(fmu, logs)
    events = sum(count.total for count in structure.events)
    is_fast = structure.step * structure.largest_rate > STIFFEST
    if structure.way == "co-simulation" or not (events or is_fast):
        return structure
    if "co-simulation" not in ways(read_description(fmu)):
        return structure
    return probe_structure(fmu, logs, way="co-simulation")


def _names(structure: Structure) -> dict[str, str]:
    """Return the model's names of the states: that of an output that shows the state, else the FMU's."""
    return {q.name: with_place(structure.shown.get(q.name, q.name)) for q in structure.states}


def _parameter(q: Quantity) -> Parameter:
    """Return the declaration of an FMU's parameter; without bounds, it keeps its sign."""
    low, high = q.bounds
    if q.start != 0.0:
        ends = sorted((q.start / WIDEST, q.start * WIDEST))
        low, high = max(low, ends[0]), min(high, ends[1])
    return Parameter(with_place(q.name), q.start, q.unit, q.doc, (low, high))


def _places(
    structure: Structure,
    sizes: Mapping[str, float],
    step: float,
    means: Mapping[str, float],
    rates: Mapping[str, float],
) -> Sequence[Place]:
    """Return the places of terms.

    Args:
        sizes: Spread of each signal along the logs, for inputs their range.
        means, rates: Output → mean, and usual rate of change, of its readings.
    """
    stepped = structure.way == "co-simulation"  # with outputs in place of states
    names = [q.name for q in (structure.outputs if stepped else structure.states)]
    units = {q.name: q.unit for q in (*structure.states, *structure.inputs, *structure.outputs)}
    places = [
        Place(with_place(q.name), {"u": q.unit, "T": "s"}, {"u": 0.5 * sizes[with_place(q.name)] or 1.0, "T": step}, k)
        for k, q in enumerate(structure.inputs)
    ]
    inputs = [q.name for q in structure.inputs]
    for pair in structure.pairs:
        v, q = with_place(pair.velocity), with_place(pair.position)
        alone = [port for port in pair.ports if port.is_alone] or pair.ports
        if stepped and not alone:
            continue
        rate = structure.scales.get(f"der({pair.velocity})") or rates.get(pair.velocity) or 1.0
        kinds = {"v": units[pair.velocity], "q": units[pair.position], "d": units[pair.position]}
        moves = {"v": sizes.get(v) or 1.0, "q": sizes.get(q) or 1.0, "d": math.sqrt(12.0) * (sizes.get(q) or 1.0)}
        port, sign, unit, size = -1, 1.0, unit_product([(units[pair.velocity], 1), ("s", -1)]), rate
        if alone:
            port, sign = inputs.index(alone[0].input), math.copysign(1.0, alone[0].gain)
            unit, size = units[alone[0].input], rate / abs(alone[0].gain)
        at = names.index(pair.position), names.index(pair.velocity)
        places.append(Place(v, {"u": unit, **kinds}, {"u": size, **moves}, port, *at, sign=sign))
    for name in structure.storages:
        size, rate = sizes.get(with_place(name)) or 1.0, structure.scales.get(f"der({name})") or 1.0
        kinds, index = {"q": units[name], "r": unit_product([(units[name], 1), ("s", -1)])}, names.index(name)
        middle = means.get(structure.shown.get(name, name), structure.states[index].start)
        places.append(Place(with_place(name), kinds, {"q": size, "r": rate}, state=index, middle=middle))
    return places
