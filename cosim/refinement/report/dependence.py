"""Signals as horizontal axis of a missing acceleration, and the choice of one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Subject
from cosim.refinement.search.missing import Smoothed
from cosim.refinement.search.shapes import Shape, signals_of

BINS = 12


@dataclass(frozen=True, eq=False)
class Regressor:
    """A signal as horizontal axis of a missing acceleration, with the rows of some logs in sequence."""

    name: str
    unit: str
    values: Array


def regressors(subject: Subject, problem: Problem, parts: Smoothed) -> dict[str, Regressor]:
    """Return name → signal as possible horizontal axis.

    Commands include rates, means and half differences.
    """
    signals, reached = signals_of(problem, parts), problem.layout.uncertain
    own = [q for q in subject.states if q.name in reached and _is_own(subject, q.name)]
    single = [Regressor("time", "s", signals["time"])]
    single += [Regressor(q.name, q.unit, _wrap_angle(signals[q.name], q.unit)) for q in own]
    speeds = [s for s in single if s.unit in {"m/s", "rad/s"}]
    products = [
        Regressor(f"{b.name} · {a.name}", f"{b.unit} · {a.unit}", a.values * b.values)
        for a, b in combinations(speeds, 2)
        if a.unit != b.unit
    ]
    return {s.name: s for s in (*single, *products, *_commands(subject, problem, parts))}


def _is_own(subject: Subject, state: str) -> bool:
    """Return whether a state belongs to the subject itself, not to an effect."""
    return state.partition(".")[0] not in subject.present


def _wrap_angle(values: Array, unit: str) -> Array:
    """Wrap an angle of several turns into one turn."""
    return np.mod(values, 2.0 * np.pi) if unit == "rad" and np.ptp(values) > 2.0 * np.pi else values


def _commands(subject: Subject, problem: Problem, parts: Smoothed) -> list[Regressor]:
    """Return varying commands with their rates, and means and half differences of two commands of equal unit."""
    logs = [(problem.logs[index], m.rows(problem.logs[index])) for index, m in parts]
    u = np.vstack([data.u[rows] for data, rows in logs])
    du = np.vstack([np.gradient(data.u, data.step, axis=0)[rows] for data, rows in logs])
    varying = [(q, u[:, k], du[:, k]) for k, q in enumerate(subject.inputs) if np.ptp(u[:, k]) > 0]
    commands = [(f"command {q.name}", q.unit, v, dv) for q, v, dv in varying]
    for (a, v, dv), (b, w, dw) in combinations(varying, 2):
        for word, sign in (("mean", 0.5), ("half difference", -0.5)) if a.unit == b.unit else ():
            name = f"{word} of commands {a.name}, {b.name}"
            commands.append((name, a.unit, 0.5 * v + sign * w, 0.5 * dv + sign * dw))
    rates = [Regressor(f"rate of {name}", f"{unit}/s", dv) for name, unit, _, dv in commands]
    return [*(Regressor(name, unit, v) for name, unit, v, _ in commands), *rates]


def explained_share(values: Array, by: Array) -> float:
    """Return the share of variance explained by a signal: the variance between bins of `by`."""
    good = np.isfinite(values) & np.isfinite(by)
    v, x = values[good], by[good]
    total = float(v.var()) if v.size else 0.0
    if total == 0.0 or np.ptp(x) == 0.0:
        return 0.0
    within = sum(float(v[rows].var()) * rows.size for rows in bins(x, BINS))
    return 1.0 - within / (total * v.size)


def bins(x: Array, count: int, least: int = 1) -> list[Rows]:
    """Return the rows in equal intervals of x.

    Intervals with fewer than `least` rows are joined with their neighbours.
    """
    low, high = float(x.min()), float(x.max())
    places = np.minimum((count * (x - low) / (high - low or 1.0)).astype(int), count - 1)
    joined: list[Rows] = []
    waiting = np.zeros(0, dtype=np.intp)
    for k in range(count):
        waiting = np.concatenate((waiting, np.flatnonzero(places == k)))
        if waiting.size >= least:
            joined.append(waiting)
            waiting = waiting[:0]
    if waiting.size:  # too few rows at the end for a separate bin
        joined[-1:] = [np.concatenate((*joined[-1:], waiting))]
    return joined


def choose(signals: Mapping[str, Regressor], suggested: Sequence[str], values: Array) -> Regressor:
    """Return the signal that explains most of the variance of `values`; suggested signals have precedence."""
    names = [n for n in suggested if n in signals] or [n for n in signals if " · " not in n]
    return signals[max(names, key=lambda n: explained_share(values, signals[n].values))]


def unnamed_term(
    subject: Subject, problem: Problem, parts: Smoothed, term: Mapping[str, Any]
) -> tuple[Regressor, Array] | None:
    """Return signal and values of an unnamed term."""
    signal, coefficient, signals = term["signal"], term["coefficient"], signals_of(problem, parts)
    if term.get("local"):
        shape = Shape.of_entry(term["equation"], term["local"])
        values = shape.columns(signals) @ np.array(term["local"]["sizes"])
        return Regressor(shape.signal, shape.unit, shape.positions(signals)), values
    basis = subject.nameless(signal)
    if basis is None:
        return None
    evaluate, units = basis
    values = np.broadcast_to(evaluate(*(signals[name] for name in units)), signals["time"].shape)
    chosen = next(iter(units), "time")
    return Regressor(chosen, units.get(chosen, "s"), signals[chosen]), coefficient * values
