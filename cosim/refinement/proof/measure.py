"""Errors of replays, their noise floor, and significant increases of errors.

Variants of a subject are compared: before, recalibrated, refined, nearest. Each replay starts from the state and effect
memory that a filter with the same variant estimates from past data only, and lasts the model's horizon (2 s, or a free
run). Errors are measured through the FMU. The noise floor needs dozens of runs and is measured through the kernel,
which gives the same results.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field
from scipy.special import stdtr

from cosim.core.arrays import Array, Flags, NamedValues, Rows
from cosim.core.errors import InputError, SimulationError
from cosim.core.linear_algebra import square_roots
from cosim.core.text import plain
from cosim.credibility.bands import (
    FREE_RUN_PARTS,
    LEAST_ROWS,
    Coverage,
    Track,
    band_horizons,
    bands_of,
    coverage_of,
    track_of,
)
from cosim.credibility.record import Correlations, Credibility, ParameterRecord
from cosim.estimation.data import past_reading, replayed
from cosim.estimation.fit import Fit, expected_values, group_values, inverse
from cosim.estimation.kernel.kernel import CORRELATION_TIME, Begin, simulate_all
from cosim.estimation.posing import with_likely_starts, with_logs
from cosim.estimation.problem import Noise, Problem
from cosim.estimation.subject.interface import Replayer, Start, Subject, Workplace
from cosim.logs.log import Log
from cosim.model.namespaces import arrays
from cosim.refinement.decision.bundle import fits_without_each_log
from cosim.refinement.search.fits import Hypothesis, Search
from cosim.residuals.drive import drive_in
from cosim.residuals.log_region import log_records, region_of_logs, rows_inside
from cosim.residuals.residual_statistics import FREE_RUN, pool_errors, remaining_excess
from cosim.residuals.windows import SKIPPED, Replay, window_rows

FLOOR_SEED = 20121
FLOOR_DRAWS = 20
FALSE_ALARM_RATE = 0.01  # probability of a false alarm for a rise on any channel
MAX_REPLAY_DIFFERENCE = 1e-9  # of fast replays from those of the delivered object, relative to max(1, largest value)

OTHER_HORIZONS: Mapping[Literal["0.5 s", "free run"], float] = {"0.5 s": 0.5, "free run": FREE_RUN}

Part = Literal["estimation", "validation"]
LogSets = Mapping[Part, Sequence[Log]]
ReplayedLogs = list[tuple[Log, Replay]]
Replayed = Mapping[str, Mapping[Part, Mapping[float, ReplayedLogs]]]  # model → set of logs → horizon


@dataclass(frozen=True, eq=False)
class Variant:
    """A subject with parameter values and noise, for filters and replays.

    Attributes:
        values: All parameters of the kernel, including sensor errors and parameters per log.
        free_noise: Noise with which the filter follows the readings, if it does not with the fitted noise.
    """

    subject: Subject
    values: NamedValues
    noise: Noise
    free_noise: Noise | None = None


def log_noise(fitted: Noise, free: Noise | None) -> Noise:
    """Return the noise of the logs, without errors of the model.

    Args:
        free: Noise of a fit with free unknown inputs, if the sensor noise in `fitted` includes model errors.
    """
    return fitted if free is None else replace(fitted, sensors=free.sensors)


def variant_of(search: Search, subject: Subject, f: Fit) -> Variant:
    """Return a subject with the noise and parameters per log of a fit."""
    of_groups = group_values(f, search.problem.settings.groups.values())
    return Variant(subject, {**subject.values, **of_groups}, f.noise, search.free_noise)


def refined_variant(search: Search, h: Hypothesis) -> Variant:
    """Return the subject with the fitted values of a hypothesis, and with more substeps if the fit needed them.

    A claim of sensor errors alone changes only sensor parameters and parameters with a stated tolerance. A parameter
    with a value per log has the mean over the logs.
    """
    subject, problem = search.subject, search.problem
    fitted = {f.name: float(h.fit.values[f.name]) for f in h.fit.free if not f.group}
    fitted |= {name: mean for name, (mean, _) in expected_values(h.fit).items()}
    stated = {p.name for p in subject.parameters if p.tolerance is not None} | {*problem.settings.tolerance}
    if {c.kind for c in h.candidates} == {"sensor"}:
        fitted = {n: v for n, v in fitted.items() if n in subject.sensor_parameters or n in stated}
    refined = subject.refined(fitted)
    times = max(log.substeps / subject.substeps(log.step) for log in problem.logs)
    if times > 1.0:
        refined = refined.with_finer_steps(times)
    refined.horizon = subject.horizon
    return variant_of(search, refined, h.fit)


def begin_replays(variant: Variant, problem: Problem, logs: Sequence[Log]) -> Problem:
    """Return the estimation problem of a variant for free runs over logs, with start states estimated for each log.

    The kernel of `problem` has all parameters, including those of the variant.
    """
    return with_likely_starts(with_logs(variant.subject, problem, logs), variant.values, variant.noise)


def replay_logs(
    variant: Variant, replayer: Replayer, problem: Problem, logs: Sequence[Log], horizons: Sequence[float] = ()
) -> dict[float, ReplayedLogs]:
    """Return horizon → corrected logs and their replays.

    The subject's own horizon is first. For further horizons, a log on which an unstable FMU stops is skipped.
    """
    problem = begin_replays(variant, problem, logs)
    judged = variant.subject.horizon
    played: dict[float, ReplayedLogs] = {judged: [], **{horizon: [] for horizon in horizons}}
    for index, log in enumerate(logs):
        values = problem.of_log(variant.values, index)
        begun = {horizon: LogReplays(variant, problem, log, index, horizon) for horizon in played}
        starts = {horizon: each.starts() for horizon, each in begun.items()}
        results = replayer.replays(log, problem.logs[index], values, starts)
        for horizon in played:
            try:
                replay = next(results)
            except SimulationError:
                if horizon == judged:
                    raise
                break  # A stopped FMU must not be called again.
            played[horizon].append((begun[horizon].corrected(replay.outputs), replay))
        results.close()
    return played


def rmse(evidence: ReplayedLogs) -> dict[str, float]:
    """Return channel → RMSE over all logs together."""
    return pool_errors(replay.errors(log) for log, replay in evidence)


class LogReplays:
    """Replays of a log over a horizon by the kernel; a filter estimates their start states from past data.

    The filter of a fit with trusted equations hardly follows the readings; replays within a log therefore start from a
    filter with free unknown inputs. A free run starts with the log.

    Attributes:
        first: Rows of the log at which replays start. rows: The same rows, counted in equal steps.
    """

    def __init__(self, variant: Variant, problem: Problem, log: Log, index: int, horizon: float | None = None) -> None:
        self.variant, self.problem, self.log, self.index = variant, problem, log, index
        self.horizon = horizon = variant.subject.horizon if horizon is None else horizon
        self.data = problem.data(variant.values, index)
        self.first = [0] if horizon == FREE_RUN else window_rows(log, horizon)
        self.rows: list[int] = log.grid[self.first].tolist()
        noise = variant.noise if variant.free_noise is None or horizon == FREE_RUN else variant.free_noise
        self.filtered = problem.filter_causally(self.data, variant.values, noise, index, self.rows)

    def starts(self) -> dict[int, Start]:
        """Return row → start of the replay."""
        problem, layout, starts = self.problem, self.problem.layout, {}
        for k, row in zip(self.first, self.rows, strict=True):
            here = problem.begin_replay(self.filtered, row)
            per_log = {name: float(here[place]) for name, place in layout.constants.items()}
            states = dict(zip(layout.states, self.filtered.states[row].tolist(), strict=True))
            states |= {layout.states[k]: float(here[k]) for k in layout.start_places}
            starts[k] = Start(states, self.filtered.memory[row], per_log)
        return starts

    def sensors(self, rows: Rows) -> Iterator[Any]:
        """Yield the sensor errors in reverse order, with parameters per log at the start of each row's replay."""
        values, constants = dict[str, Any](self.variant.values), self.problem.layout.constants
        if constants:
            begin = np.array(self.rows or [len(self.filtered.states) - 1], np.intp)
            of_row = begin[np.maximum(0, np.searchsorted(begin, rows, side="left") - 1)].tolist()
            states = {k: self.problem.drop_unknown_inputs(self.filtered.states[k]) for k in set(of_row)}
            values |= {name: np.array([states[k][place] for k in of_row]) for name, place in constants.items()}
        for kind in reversed(self.variant.subject.sensors):
            yield kind(value=values[f"{kind.name}.value"])

    def corrected(self, simulated: Mapping[str, Array]) -> Log:
        """Return the log without the modelled sensor errors.

        Args:
            simulated: Output → simulated value, for sensor errors that depend on the past or on other outputs.
        """
        log, outputs = self.log, dict(self.log.outputs)
        for sensor in self.sensors(log.grid):
            read = [n for n in sensor.affected() if n in outputs]
            if sensor.is_straight():
                at_zero, gain = _line(sensor)
                outputs |= {n: (outputs[n] - at_zero) / gain for n in read}
            elif sensor.dormant:
                continue
            elif sensor.depends_on_past():
                late = {n: past_reading(sensor, log.time, simulated[n], outputs[n]) - simulated[n] for n in read}
                outputs |= {n: outputs[n] - error for n, error in late.items()}
            else:
                clean = {n: np.nan_to_num(simulated[n]) for n in sensor.affected()}
                readings = sensor.readings(arrays(), log.time, {**simulated, **clean})
                outputs |= {n: outputs[n] - np.asarray(readings[n] - clean[n]) for n in read}
        return replace(log, outputs=outputs)

    @cached_property
    def gains(self) -> Array:
        """Return the gain of each output's sensor in each row."""
        every_row = np.arange(len(self.data.u))
        gains = dict.fromkeys(self.problem.layout.outputs, np.ones(len(every_row)))
        for sensor in self.sensors(every_row):
            if sensor.is_straight():
                gains |= {n: gains[n] * _line(sensor)[1] for n in sensor.affected() if n in gains}
        return np.column_stack(list(gains.values()))

    @cached_property
    def predicted(self) -> Array:
        """Return the outputs of the replays, NaN in rows without prediction."""
        starts = {k: self.problem.begin_replay(self.filtered, k) for k in self.rows}
        return self._simulate(self.variant.values, starts)

    def errors(self) -> dict[str, Array]:
        """Return channel → corrected measurement − model."""
        return dict(zip(self.problem.layout.outputs, ((self.data.y - self.predicted) / self.gains).T, strict=True))

    def random_errors(self, rng: np.random.Generator) -> dict[str, Array]:
        """Return the errors of replays against a simulation with random noise and random deviations of start states."""
        problem, noise, data, rows = self.problem, self.variant.noise, self.data, self.rows
        errors = rng.standard_normal(data.y.shape) * np.sqrt(problem.variances(noise, self.index))
        if problem.layout.is_free_run:  # deviations of the outputs, driven by the fitted unknown inputs
            propagation = problem.kernel.responses(data, problem.x0[self.index])[1]  # type: ignore[attr-defined]
            fades = math.exp(-data.step / math.exp(noise.memory))
            inputs = rng.standard_normal(data.y.shape) * np.exp(0.5 * noise.power)
            deviations = np.zeros((len(inputs) + 1, inputs.shape[1]))  # one more row, for the row before the first
            for k in range(1, len(inputs)):
                both = np.concatenate([deviations[k], deviations[k - 1]])
                deviations[k + 1] = propagation @ both + data.step * inputs[k - 1]
                inputs[k] = fades * inputs[k - 1] + math.sqrt(1.0 - fades**2) * inputs[k]
            errors += deviations[1:]
        else:
            layout, starts = problem.layout, self.filtered.states.copy()
            if self.filtered.covariances is not None:
                roots = square_roots(self.filtered.covariances[rows])
                random = rng.standard_normal((len(rows), len(layout.stochastic), 1))
                starts[np.ix_(rows, list(layout.stochastic))] += (roots @ random)[..., 0]
            noisy = len(layout.noise_places)
            deviation = np.exp(0.5 * noise.power)  # replays do not contain the unknown inputs
            starts[np.ix_(rows, layout.noise_places)] = rng.standard_normal((len(rows), noisy)) * deviation
            density = problem.densities(noise)[list(layout.noisy)]
            kicks = np.zeros((len(data.u), len(layout.states)))
            kicks[:, layout.noise_places] = rng.standard_normal((len(data.u), noisy)) * np.sqrt(density * data.step)
            memory = {CORRELATION_TIME: math.exp(noise.memory)}
            with np.errstate(invalid="ignore"):  # where both diverge
                errors += self._simulate({**self.variant.values, **memory}, starts, kicks) - self.predicted
        errors = np.where(np.isnan(data.y), np.nan, errors) / self.gains
        return dict(zip(problem.layout.outputs, errors.T, strict=True))

    def _simulate(self, values: NamedValues, starts: Mapping[int, Array] | Array, kicks: Array | None = None) -> Array:
        """Return outputs of simulations from given states; infinite where they diverge, NaN in other rows."""
        problem, data, horizon = self.problem, self.data, self.horizon
        length = len(data.u) if horizon == FREE_RUN else round(horizon / data.step)
        p, outputs = problem.parameters(values, self.index), np.full(data.y.shape, np.nan)
        parts = {k: data.rows(0, min(k + length, len(data.u) - 1) + 1) for k in self.rows}
        begins: list[Begin] = [(part, p, starts[k], self.filtered.memory[k], kicks, k) for k, part in parts.items()]
        for (k, part), run in zip(parts.items(), simulate_all(problem.kernel, begins), strict=True):
            end = len(part.u) - 1
            read = run.outputs[k:]
            if part.late is not None:  # shifted by the age of each reading
                read = read - np.nan_to_num(part.late[k:]) * np.diff(read, axis=0, prepend=read[:1])
            outputs[k + 1 : end + 1] = np.where(np.isnan(read[1:]), np.inf, read[1:])
        rows = np.arange(len(outputs), dtype=np.float64)
        for j, lag in enumerate(data.lags if data.lags is not None else ()):
            if lag:
                outputs[:, j] = replayed(rows, outputs[:, j], float(lag), data.y[:, j])
        return outputs


def _line(sensor: Any) -> tuple[Any, Any]:
    """Return offset and gain of a sensor with a linear error."""
    at_zero = sensor.measure(0.0)
    return at_zero, sensor.measure(1.0) - at_zero


def predicted_errors(variants: Sequence[Variant], problem: Problem, logs: Sequence[Log]) -> dict[str, float]:
    """Return the RMSE of each channel in kernel replays, infinite if a replay diverges.

    Args:
        variants: One for each log.
    """
    errors = [
        LogReplays(variant, begin_replays(variant, problem, logs), log, k).errors()
        for k, (variant, log) in enumerate(zip(variants, logs, strict=True))
    ]
    diverged = {n for of in errors for n, e in of.items() if np.isinf(e).any()}
    return {n: math.inf if n in diverged else size for n, size in pool_errors(errors).items()}


Floors = Mapping[Part, NamedValues]  # set of logs → channel → noise floor


def noise_floor(variant: Variant, problem: Problem, logs: Sequence[Log], rng: np.random.Generator) -> dict[str, float]:
    """Return the noise floor: errors of replays against simulations of the same model with random noise.

    Each simulation starts at the filtered state plus a random deviation with the filter's covariance, so that it stays
    near the motion in the log. A floor above the standard deviation of its channel is left out.
    """
    problem = begin_replays(variant, problem, logs)
    draws = list[dict[str, Array]]()
    for index, log in enumerate(logs):
        replays = LogReplays(variant, problem, log, index)
        draws += [replays.random_errors(rng) for _ in range(-(-FLOOR_DRAWS // len(logs)))]
    level = {}
    for name, size in pool_errors(draws).items():
        readings = np.concatenate([np.zeros(0), *(log.outputs[name] for log in logs if name in log.outputs)])
        readings = readings[np.isfinite(readings)]
        if readings.size < 2 or size <= float(np.std(readings)):
            level[name] = size
    return level


def find_rises(before: ReplayedLogs, after: ReplayedLogs) -> dict[str, tuple[float, float]]:
    """Return channel → error before and after, for channels whose error has risen significantly.

    Student's t test is applied to ln(Σe² after / Σe² before) of the replays, so that all replays have equal weight,
    however large their errors. The channels share the false-alarm probability (Bonferroni).
    """
    old, new = rmse(before), rmse(after)
    rises = {
        name: (old[name], new[name])
        for name in old.keys() & new.keys()
        if new[name] > old[name] and is_significant_rise(_log_ratios(before, after, name), FALSE_ALARM_RATE / len(old))
    }
    return dict(sorted(rises.items(), key=lambda item: item[1][0] / item[1][1]))  # largest ratio first


def is_significant_rise(rises: Sequence[float], chance: float) -> bool:
    """Return True if the mean rise is significantly positive by Student's t-test."""
    if len(rises) < 2:
        return False
    with np.errstate(divide="ignore", invalid="ignore"):  # rises may be equal
        t = np.mean(rises) / (np.std(rises, ddof=1) / np.sqrt(len(rises)))
    return bool(stdtr(len(rises) - 1, -t) < chance)


def remaining_on_sealed_logs(before: ReplayedLogs, after: ReplayedLogs, floor: NamedValues) -> dict[str, float]:
    """Return channel → share of the excess error of the replays `before` that remains in the replays `after`.

    The excess error is the RMSE above the noise `floor`; channels without it are omitted.
    """
    old, new = rmse(before), rmse(after)
    shares = {n: remaining_excess(old[n], new[n], f) for n, f in floor.items() if n in old and n in new}
    return {n: max(0.0, share) for n, share in shares.items() if math.isfinite(share)}


def _log_ratios(before: ReplayedLogs, after: ReplayedLogs, name: str) -> list[float]:
    """Return ln(Σe² after / Σe² before) of each replay."""
    ratios: list[float] = []
    for (log, first), (corrected, second) in zip(before, after, strict=True):
        if name not in log.outputs:
            continue
        with np.errstate(over="ignore"):  # a diverging model may overflow
            a, b = ((x.outputs[name] - replay.outputs[name]) ** 2 for x, replay in ((log, first), (corrected, second)))
        both = np.isfinite(a) & np.isfinite(b)
        edges = [*(k + 1 for k in sorted(first.starts)), log.rows]  # a start row belongs to the previous replay
        if math.isinf(first.horizon):
            edges = [round(k * log.rows / FREE_RUN_PARTS) for k in range(FREE_RUN_PARTS + 1)]
        parts = [slice(x, y) for x, y in pairwise(edges)]
        sums = [(float(a[p][both[p]].sum()), float(b[p][both[p]].sum())) for p in parts]
        ratios += [math.log(y / x) for x, y in sums if 0.0 < x < math.inf and 0.0 < y < math.inf]
    return ratios


# Replays of all variants on all sets of logs, by a fast replayer if its results equal those of the delivered object.
#
# The delivered object replays one log for comparison. If results differ, or if there is no fast replayer, the delivered
# object replays all logs, which the record states.


class Replays(BaseModel):
    """FMUs used for the replays.

    why: reason why no native FMU was used; empty if one was used
    log: log that plant.fmu has replayed for comparison
    apart: relative difference of both replays of this log
    """

    through: Literal["native", "python", "own"]
    why: str = ""
    log: str = ""
    apart: Annotated[float, Field(allow_inf_nan=False)] | None = None


def replay_variants(
    variants: Mapping[str, Variant], problem: Problem, sets: LogSets, place: Workplace
) -> tuple[Replayed, Replays]:
    """Replay every variant on every set of logs; return the replays, and which FMU was used."""

    def replay_all(replayer_of: Callable[[Subject], Replayer]) -> Replayed:
        done: dict[int, dict[Part, dict[float, ReplayedLogs]]] = {}
        for variant in variants.values():
            if id(variant) not in done:  # a variant that occurs twice is replayed once
                source = variant, replayer_of(variant.subject), problem
                horizons = list(OTHER_HORIZONS.values())
                done[id(variant)] = {part: replay_logs(*source, logs, horizons) for part, logs in sets.items()}
        return {name: done[id(variant)] for name, variant in variants.items()}

    def replay_delivered() -> Replayed:
        return replay_all(lambda subject: subject.replayer(place))

    after = variants["after"]
    own = after.subject.replayer(place)
    ways, why = dict[int, Replayer](), ""
    subjects = {id(v.subject): v.subject for v in variants.values()}
    try:
        ways = {key: way for key, s in subjects.items() if (way := s.quick_replayer(place)) is not None}
    except InputError as error:
        why = error.faults[0].message
    if len(ways) < len(subjects):
        return replay_delivered(), Replays(through=own.through, why=why)
    played = replay_all(lambda subject: ways[id(subject)])
    part: Part = "validation" if "validation" in sets else "estimation"
    k, log = min(enumerate(sets[part]), key=lambda entry: entry[1].rows)
    horizon, name = after.subject.horizon, log.path.name
    replay = replay_logs(after, own, problem, [log])[horizon][0][1]
    apart = difference(played["after"][part][horizon][k][1], replay)
    if apart <= MAX_REPLAY_DIFFERENCE:
        return played, Replays(through=ways[id(after.subject)].through, log=name, apart=apart)
    why = f"replays of {name} through it and through plant.fmu are {plain(apart, 2)} apart"
    finite = apart if math.isfinite(apart) else None
    return replay_delivered(), Replays(through=own.through, why=why, log=name, apart=finite)


def difference(one: Replay, other: Replay) -> float:
    """Return the largest relative difference of outputs, which may be infinite."""
    largest = 0.0
    for name, values in one.outputs.items():
        others, rows = other.outputs[name], np.isfinite(other.outputs[name])
        if not np.array_equal(rows, np.isfinite(values)):
            return float("inf")
        apart = np.max(np.abs(values[rows] - others[rows]), initial=0.0)
        largest = max(largest, float(apart) / float(np.max(np.abs(others[rows]), initial=1.0)))
    return largest


# The record of credibility of a refined FMU: replays of held-out estimation logs, and the region of these logs.


FIRST_BAND_INTERVAL = 0.25  # of the horizon of a model, the first interval of a band


def credibility_of(
    search: Search,
    h: Hypothesis | None,
    variant: Variant,
    replayed: Mapping[Part, ReplayedLogs],
    sets: LogSets,
    *,
    place: Workplace,
    fmu: Path,
) -> tuple[Credibility, Coverage | None]:
    """Return the record of a delivered FMU without its verdict, and the coverage of its bands on sealed logs.

    Args:
        h: Delivered hypothesis; None for the given model.
        variant: The delivered model.
        replayed: Replays of the delivered model over its horizon, by set of logs.
    """
    logs, sealed = sets["estimation"], sets.get("validation", ())
    problem = search.problem
    with drive_in(place.worker, logs[0], fmu, limits=place.limits) as driven:
        region = region_of_logs(driven, replayed["estimation"])
        inside = rows_inside(region, driven, replayed["validation"]) if sealed else []
    without = [variant] * len(logs)
    if h is not None:
        without = [refined_variant(search, replace(h, fit=f)) for f in fits_without_each_log(search, h)]
    longest, first = float(max(log.time[-1] - log.time[0] for log in logs)), variant.subject.horizon
    free_run = {longest: FREE_RUN} if first == FREE_RUN or problem.layout.is_free_run else {}
    horizons = free_run  # the end of each interval of the bands → horizon of its replays
    if not problem.layout.is_free_run:  # else replays begin with a log only
        first = FIRST_BAND_INTERVAL * (longest / 10.0 if free_run else first)
        first = max(first, LEAST_ROWS * max(log.step for log in logs))
        durations = [float(log.time[-1] - log.time[0]) - SKIPPED for log in logs]
        horizons = {h: h for h in band_horizons(durations, first)} | free_run
    tracks = _tracks(without, problem, logs, horizons)
    units = {q.name: q.unit for q in search.subject.outputs}
    bands = bands_of(tracks, units, held_out=h is None or len(logs) > 1, free=bool(free_run))
    coverage = None
    if sealed and not bands.reason:
        coverage = coverage_of(bands, _tracks([variant] * len(sealed), problem, sealed, horizons, inside))
    parameters, correlations = dict[str, ParameterRecord](), Correlations()
    if h is not None:
        f, declared = h.fit, search.subject.declared
        places = [k for k, p in enumerate(f.free) if not p.group]
        names = [f.free[k].name for k in places]
        parameters = {
            n: ParameterRecord(value=float(f.values[n]), unit=declared[n].unit, ci95=f.interval(n)) for n in names
        }
        matrix = inverse(f.information)[np.ix_(places, places)]
        roots = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        within = np.clip(matrix / np.outer(roots, roots), -1.0, 1.0)
        correlations = Correlations(names=names, matrix=within.tolist())
    record = Credibility(
        command="cosim refine",
        model=search.subject.title,
        verdict="",
        sentence="",
        logs=log_records(logs),
        sealed=log_records(sealed),
        parameters=parameters,
        correlations=correlations,
        region=region,
        bands=bands,
    )
    return record, coverage


def _tracks(
    variants: Sequence[Variant],
    problem: Problem,
    logs: Sequence[Log],
    horizons: Mapping[float, float],
    inside: Sequence[Flags] = (),
) -> dict[float, list[Track]]:
    """Return end of interval → track (replay errors) of each log, replayed by its own variant."""
    tracks: dict[float, list[Track]] = {end: [] for end in horizons}
    for k, (variant, log) in enumerate(zip(variants, logs, strict=True)):
        begun = begin_replays(variant, problem, logs)
        for end, horizon in horizons.items():
            replays = LogReplays(variant, begun, log, k, horizon)
            rows = np.arange(len(replays.data.u))
            time: Array = log.time[0] + replays.data.step * rows
            within = inside[k][np.minimum(np.searchsorted(log.grid, rows), log.rows - 1)] if inside else None
            tracks[end].append(track_of(time, replays.rows, replays.errors(), inside=within, free=horizon == FREE_RUN))
    return tracks
