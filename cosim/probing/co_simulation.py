"""Structure of an FMU for co-simulation: pairs among its outputs, and its response to steps of single inputs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from functools import partial
from itertools import permutations

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.errors import SimulationError
from cosim.blocks.derivatives import reals, scalars
from cosim.probing.fmu_structure import Pair, Port, Structure
from cosim.probing.log_runs import NAME, SAME, Course, Fmu, amplitude_of, run_co_simulation
from cosim.probing.parameter_trials import tried_parameters
from cosim.probing.prober import Prober, no_flags, quantities, separate_pairs

ROWS = 300  # rows of a simulation for responses and parameters
PAIR_ERROR = 1e-2  # error of an integrated velocity relative to the position's increments
UNITY = 1e-3  # difference of a gain from 1 that counts as integration error
STEPS = (0.2, 0.5, 0.8)  # places of input steps, as shares of a course
DIRECT = 2.8  # response after two steps over that after one: about 2 through one integrator, 4 through two


def outputs_along(fmu: Fmu, course: Course) -> tuple[Array, str]:
    """Return the real outputs along a course, and the reason of an early end. Runs in the worker."""
    block, row = fmu.opened_for_steps(course)
    with closing(block):
        table, stop = run_co_simulation(block, row, course)
        names = [s.name for s in block.outputs]
    return table[:, [names.index(name) for name in scalars(reals(fmu.description, "output"))]], stop


def co_simulation_structure(prober: Prober, courses: Sequence[Course]) -> Structure:
    """Return the structure of an FMU for co-simulation.

    Raises:
        SimulationError: The FMU fails at its start.
    """
    fmu = prober.fmu
    _, inputs, outputs = fmu.names
    runs: list[tuple[Array, str]] = [prober.call(outputs_along, fmu, course) for course in courses]
    good = [(course, table) for course, (table, _) in zip(courses, runs, strict=True) if len(table) > 2]
    if not good:
        raise SimulationError(NAME, float(courses[0].time[0]), runs[0][1])
    values = np.concatenate([table for _, table in good])
    size = np.maximum(np.abs(values).max(axis=0), SAME)
    short, base = good[0][0].first(min(ROWS, len(good[0][1]))), good[0][1][:ROWS]
    responses = Responses(prober, short, base, size)
    chosen = separate_pairs(_fits(good))
    ports = responses.ports(inputs, [v for _, v, _ in chosen])
    spreads = {name: float(np.std(_known(name, good))) for name in inputs}
    return Structure(
        fmu=prober.path,
        way="co-simulation",
        states=(),
        inputs=quantities(prober.description, inputs, [float(_known(name, good)[0]) for name in inputs]),
        outputs=quantities(prober.description, outputs, good[0][1][0]),
        state_in_rate=no_flags(0, 0),
        input_in_rate=no_flags(0, len(inputs)),
        state_in_output=no_flags(len(outputs), 0),
        input_in_output=responses.flags(inputs),
        pairs=tuple(Pair(outputs[q], outputs[v], gain, ports[v]) for q, v, gain in chosen),
        storages=(),
        shown={},
        largest_rate=0.0,
        slowest=0.0,
        scales={**spreads, **dict(zip(outputs, map(float, values.std(axis=0)), strict=True))},
        step=min(course.step for course in courses),
        parameters=tried_parameters(prober, partial(_react, prober, short), size),
        stops=tuple(stop for _, stop in runs if stop),
    )


def _react(prober: Prober, course: Course, fmu: Fmu) -> tuple[Array, Array]:
    """Return the initial and the later outputs along a course."""
    table, stop = prober.call(outputs_along, fmu, course)
    if not len(table):
        raise SimulationError(NAME, float(course.time[0]), stop)
    return table[0], table[1:]


def _known(name: str, good: Sequence[tuple[Course, Array]]) -> Array:
    """Return the values of an input along all courses, 0 without any."""
    values = [course.inputs[name] for course, _ in good if name in course.inputs]
    return np.concatenate(values) if values else np.zeros(1)


def _fits(good: Sequence[tuple[Course, Array]]) -> list[tuple[int, int, float]]:
    """Return position, velocity and gain for outputs of which one is the integral of the other times the gain.

    The integral is of the trapezoidal rule. Its error may reach that of Euler's method with the step of the log.
    """
    rises = np.concatenate([np.diff(table, axis=0) for _, table in good])
    steps = [np.diff(course.time[: len(table)])[:, None] for course, table in good]
    areas = np.concatenate([0.5 * h * (t[1:] + t[:-1]) for h, (_, t) in zip(steps, good, strict=True)])
    euler = np.concatenate([0.5 * h * np.diff(t, axis=0) for h, (_, t) in zip(steps, good, strict=True)])
    fits = []
    for q, v in permutations(range(rises.shape[1]), 2):
        power = float(areas[:, v] @ areas[:, v])
        if power == 0.0:
            continue
        gain = float(rises[:, q] @ areas[:, v]) / power
        error, size = _rms(rises[:, q] - gain * areas[:, v]), _rms(rises[:, q])
        if size > 0.0 and error <= min(PAIR_ERROR * size, abs(gain) * _rms(euler[:, v]) + SAME * size):
            fits.append((q, v, 1.0 if abs(gain - 1.0) <= UNITY else gain))
    return fits


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values * values)))


class Responses:
    """Differences of an FMU's outputs after a step of one input.

    Args:
        base: Outputs without a step.
        size: Magnitude of each output.
    """

    def __init__(self, prober: Prober, course: Course, base: Array, size: Array) -> None:
        self._prober, self._course, self._base, self._size = prober, course, base, size
        repeated, _ = prober.call(outputs_along, prober.fmu, course)
        rows = min(len(repeated), len(base))
        self._noise = 10.0 * np.abs(repeated[:rows] - base[:rows]).max(axis=0, initial=0.0) + SAME * size
        self._known: dict[tuple[str, float], tuple[int, float, Array]] = {}

    def flags(self, inputs: Sequence[str]) -> Flags:
        """Return whether an input (column) changes an output (row) at any time."""
        return np.column_stack([self.reaches(n) for n in inputs]) if inputs else no_flags(self._size.size, 0)

    def reaches(self, name: str) -> Flags:
        """Return for each output whether the input changes it at any time."""
        _, _, difference = self._response(name, STEPS[0])
        return np.asarray((np.abs(difference) > self._noise).any(axis=0))

    def ports(self, inputs: Sequence[str], velocities: Sequence[int]) -> dict[int, tuple[Port, ...]]:
        """Return the inputs that change a velocity by as much in the second step as in the first."""
        gains = {(v, name): self._gain(name, v) for v in velocities for name in inputs}
        ports = {}
        for v in velocities:
            mine = [name for name in inputs if gains[v, name]]
            alone = {name: sum(bool(gains[other, name]) for other in velocities) == 1 for name in mine}
            ports[v] = tuple(Port(name, gains[v, name], alone[name]) for name in mine)
        return ports

    def _gain(self, name: str, output: int) -> float:
        """Return the rate of a velocity per unit of an input that acts through one integrator, else 0."""
        gains = []
        for share in STEPS:
            row, size, difference = self._response(name, share)
            once, twice = difference[row + 1 : row + 3, output] if len(difference) > row + 2 else (0.0, 0.0)
            if abs(once) > self._noise[output] and abs(twice) < DIRECT * abs(once):
                gains.append(float(once) / (size * float(self._course.time[row + 1] - self._course.time[row])))
        return float(np.median(gains)) if 2 * len(gains) > len(STEPS) else 0.0

    def _response(self, name: str, share: float) -> tuple[int, float, Array]:
        """Return the row and the size of a step of an input, and the differences of all outputs."""
        if (name, share) not in self._known:
            variable = next(v for v in self._prober.description.modelVariables if v.name == name)
            course = self._course
            held = course.inputs.get(name)
            if held is None:
                start = float(self._prober.values.get(name, variable.start or 0.0))
                held = np.full(course.time.size, start)
                course = Course(course.name, course.time, {**course.inputs, name: held}, course.outputs, course.step)
            size = float(np.std(held)) or amplitude_of(variable, float(held[0]))
            row = int(share * (course.time.size - 3))
            table, _ = self._prober.call(outputs_along, self._prober.fmu, course.with_step(name, row, size))
            rows = min(len(table), len(self._base))
            self._known[name, share] = row, size, table[:rows] - self._base[:rows]
        return self._known[name, share]
