"""Structure of an FMU for co-simulation: position-velocity pairs among its outputs, and responses to input steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from cosim.core.arrays import Array, Flags
from cosim.core.errors import SimulationError
from cosim.fmi.description import takes_any_step
from cosim.probing.fmu_structure import Pair, Port, Structure
from cosim.probing.prober import (
    SAME,
    Course,
    Fmu,
    Prober,
    moved,
    noise_of,
    outputs_along,
    quantities,
    separate_pairs,
    settable_parameters,
    start_values,
    tried_parameters,
)

RESPONSE_ROWS = 300  # rows of a simulation for step responses
ALL_PARAMETERS_ROWS, MIN_PARAMETER_ROWS = 15000, 5  # rows over the simulations of all parameters, and least of each
SPAN, MOST_JITTER = 32, 0.1  # rows per increment if single increments jitter, and largest error of single increments
PAIR_ERROR = 1e-2  # error of an integrated velocity relative to the position's increments
UNIT_GAIN_TOLERANCE = 1e-3  # minimum difference of a gain from 1 that is not integration error
STEP_TIME_SHARES = (0.2, 0.5, 0.8)  # times of input steps, as shares of a course
PARTS_OF_STEP = 32  # size of a part of a step, in the search for lags
MOST_GAIN = 4.0  # gain over a part relative to that over a step, beyond which the FMU makes steps of its own
# response after two steps divided by the response after one: about 2 through one integrator, 4 through two
MAX_SINGLE_INTEGRATOR_RATIO = 2.8
MIN_STORAGE_RATIO = 1.4  # minimum of this ratio for a storage; 1 without an integrator, 2 for a storage without losses


def co_simulation_structure(prober: Prober, courses: Sequence[Course]) -> Structure:
    """Return the structure of an FMU for co-simulation.

    Raises:
        SimulationError: The FMU fails at its start.
    """
    fmu = prober.fmu
    _, inputs, outputs = fmu.names
    runs: list[tuple[Array, SimulationError | None]] = [prober.call(outputs_along, fmu, course) for course in courses]
    # If a simulation fails late, the rows before the failure suffice.
    counts = [len(table) > (SPAN if stop else 2) for table, stop in runs]
    good = [(course, table) for course, (table, _), counted in zip(courses, runs, counts, strict=True) if counted]
    if not good:
        raise runs[0][1] or fmu.too_short(courses[0])
    values = np.concatenate([table for _, table in good])
    size = np.maximum(np.abs(values).max(axis=0), SAME)
    short, base = good[0][0].first(min(RESPONSE_ROWS, len(good[0][1]))), good[0][1][:RESPONSE_ROWS]
    responses = Responses(prober, short, base, size)
    chosen = separate_pairs(_fits(good))
    ports = responses.ports(inputs, [v for _, v, _ in chosen])
    # Outputs of pairs are not storages. The feed of a storage is the first input that changes only this storage.
    paired = {k for position, velocity, _ in chosen for k in (position, velocity)}
    found = responses.ports(inputs, [k for k in range(len(outputs)) if k not in paired], MIN_STORAGE_RATIO)
    feeds = {outputs[k]: port for k, acting in found.items() for port in acting[::-1] if port.is_alone}
    columns = {name: [course.inputs[name] for course, _ in good if name in course.inputs] for name in inputs}
    spreads = {name: float(np.std(np.concatenate(c))) if c else 0.0 for name, c in columns.items()}
    count = max(1, len(settable_parameters(prober.description)))
    tried = short.first(max(MIN_PARAMETER_ROWS, ALL_PARAMETERS_ROWS // count))

    def react(fmu: Fmu) -> tuple[Array, Array]:
        """Return the outputs after initialization, and in all later rows."""
        table, stop = prober.call(outputs_along, fmu, tried)
        if not len(table):
            raise stop
        return table[0], table[1:]

    return Structure(
        fmu=prober.path,
        way="co-simulation",
        states=(),
        inputs=quantities(prober.description, inputs),
        outputs=quantities(prober.description, outputs, good[0][1][0]),
        depends=responses.flags(inputs),
        pairs=tuple(Pair(outputs[q], outputs[v], gain, ports[v]) for q, v, gain in chosen),
        storages=tuple(feeds),
        feeds=feeds,
        scales={**spreads, **dict(zip(outputs, map(float, values.std(axis=0)), strict=True))},
        step=min(course.step for course in courses),
        parameters=tried_parameters(prober, react, size),
        starts=start_values(prober, short, base[: short.time.size], responses.noise),
        stops=tuple(str(stop) for _, stop in runs if stop),
    )


def _fits(good: Sequence[tuple[Course, Array]]) -> list[tuple[int, int, float]]:
    """Return (position, velocity, gain) for pairs of outputs with position = gain · integral of velocity.

    The integral uses the trapezoidal rule. Its error may be as large as that of Euler's method with the step of the
    log. If an FMU rounds communication points to its own steps, single increments jitter, and longer increments are
    used.
    """
    width = good[0][1].shape[1]
    # increments of all outputs, their trapezoidal integrals, and the sums of both over spans of rows
    parts: tuple[list[Array], ...] = [], [], [], [], []
    for course, table in good:
        h = np.diff(course.time[: len(table)])[:, None]
        steps = np.diff(table, axis=0), 0.5 * h * (table[1:] + table[:-1])
        spans = len(steps[0]) // SPAN
        sums = (each[: spans * SPAN].reshape(spans, SPAN, width).sum(axis=1) for each in steps)
        for part, values in zip(parts, (*steps, 0.5 * h * steps[0], *sums), strict=True):
            part.append(values)
    rises, areas, euler, long_rises, long_areas = map(np.concatenate, parts)
    fits = []
    for q, v in permutations(range(width), 2):
        power = float(areas[:, v] @ areas[:, v])
        if power == 0.0:
            continue
        gain = float(rises[:, q] @ areas[:, v]) / power
        error, size, first_order = _rms(rises[:, q] - gain * areas[:, v]), _rms(rises[:, q]), _rms(euler[:, v])
        is_exact = error <= min(PAIR_ERROR * size, abs(gain) * first_order + SAME * size)
        over_spans = _rms(long_rises[:, q] - gain * long_areas[:, v]) <= PAIR_ERROR * _rms(long_rises[:, q])
        if size > 0.0 and (is_exact or (error <= MOST_JITTER * size and over_spans)):
            bias = max(UNIT_GAIN_TOLERANCE, error / size if not is_exact else first_order**2 * areas.shape[0] / power)
            fits.append((q, v, 1.0 if abs(gain - 1.0) <= bias else gain))
    return fits


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values * values))) if len(values) else np.nan


class Responses:
    """Changes of an FMU's outputs due to a step of one input.

    Args:
        base: Outputs without a step of an input.
        size: Magnitude of each output.

    Attributes:
        noise: Differences between repeated simulations, due to rounding or randomness.
    """

    def __init__(self, prober: Prober, course: Course, base: Array, size: Array) -> None:
        self._prober, self._size, self._course = prober, size, course
        repeated, _ = prober.call(outputs_along, prober.fmu, course)
        self.noise = noise_of(base, repeated, size)
        self._bases: dict[tuple[float, int], Array] = {}

    def flags(self, inputs: Sequence[str]) -> Flags:
        """Return an array of Booleans: True if an input (column) changes an output (row) at any time."""
        responses = (self._response(name, STEP_TIME_SHARES[0], 1)[0] for name in inputs)
        columns = [(np.abs(response) > self.noise).any(axis=0) for response in responses]
        return np.column_stack([np.zeros((self._size.size, 0), bool), *columns])

    def ports(
        self, inputs: Sequence[str], velocities: Sequence[int], least: float = 0.0
    ) -> dict[int, tuple[Port, ...]]:
        """Return velocity or storage → inputs that change it equally in the first and second step.

        Args:
            least: Least ratio of the response after two steps to the response after one.
        """
        gains, takes_parts = dict[tuple[int, str], float](), takes_any_step(self._prober.description)
        for v, name in product(velocities, inputs):
            # Parts of a step reveal a lag that a whole step hides. If an FMU rounds parts to whole steps, the gain
            # differs and is not used.
            whole = self._gain(name, v, 1, least)
            fine = self._gain(name, v, PARTS_OF_STEP, least) if whole and takes_parts else whole
            gains[v, name] = whole if abs(fine) > MOST_GAIN * abs(whole) else fine
        ports = {}
        for v in velocities:
            mine = [name for name in inputs if gains[v, name]]
            alone = {name: sum(bool(gains[other, name]) for other in velocities) == 1 for name in mine}
            ports[v] = tuple(Port(name, gains[v, name], alone[name]) for name in mine)
        return ports

    def _gain(self, name: str, velocity: int, parts: int, least: float) -> float:
        """Return the derivative of a velocity per unit of an input that acts through one integrator, else 0.

        The derivative is measured over a part of a step; the result is the median over several times.

        Args:
            parts: Number of parts into which a step is divided.
            least: Smallest ratio of the change after two parts to that after one part.
        """
        gains = []
        for share in STEP_TIME_SHARES:
            response, scale = self._response(name, share, parts)
            if len(response) > 2:
                once, twice = response[1:3, velocity]
                ratio = abs(twice) / max(abs(once), np.finfo(float).tiny)
                if abs(once) > self.noise[velocity] and least < ratio < MAX_SINGLE_INTEGRATOR_RATIO:
                    gains.append(float(once) / scale)
        return float(np.median(gains)) if 2 * len(gains) > len(STEP_TIME_SHARES) else 0.0

    def _response(self, name: str, share: float, parts: int) -> tuple[Array, float]:
        """Return the output changes from the row of an input step on, and input step size × row duration.

        The communication steps after the input step are divided into parts.
        """
        row = int(share * (self._course.time.size - 3))
        course = self._course.parted(row, parts)
        key = share, course.time.size
        if key not in self._bases:
            self._bases[key], _ = self._prober.call(outputs_along, self._prober.fmu, course)
        variable = next(v for v in self._prober.description.modelVariables if v.name == name)
        held = course.inputs.get(name)
        if held is None:
            held = np.full(course.time.size, float(variable.start or 0.0))
        changed = moved(variable, held)
        size = float(changed[row] - held[row]) or 1.0
        values = np.where(np.arange(course.time.size) < row, held, changed)
        stepped = replace(course, inputs={**course.inputs, name: values})
        table, _ = self._prober.call(outputs_along, self._prober.fmu, stepped)
        rows = min(len(table), len(self._bases[key]))
        return (table[:rows] - self._bases[key][:rows])[row:], size * float(course.time[row + 1] - course.time[row])
