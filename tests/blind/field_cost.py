"""Evidence for an effect: the log-likelihood [nats] lost by the true model without the effect.

The estimate is linear and Gaussian, and uses nothing of the project. An extended Kalman filter about the true run knows
the true sensor noise and the size and correlation time of the disturbance. It returns the change of the innovations
without the effect. Base parameters (within their tolerances) and the study's further effects may imitate a part of this
change. Half the square of the rest is the cost.

    python -m tests.blind.field_cost 40 --first 0      costs of the known studies among 40 seeds
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.blind.field_rig import Arrays, Flat, Rig, Run

Values = dict[str, float]


@dataclass(frozen=True)
class Conditions:
    """Logs for the cost: courses, variance of each cell (infinite without measurement), deviations of the pushes."""

    runs: Sequence[Run]
    variances: Sequence[np.ndarray]  # (rows, outputs) each
    push_deviations: Sequence[float]


def costs(rig: Rig, base: Values, truth: Mapping[str, Values], given: Conditions) -> dict[str, float]:
    """Return effect → nats lost without it, after a refit of base parameters and further effects."""
    p = rig.numbers(base, truth)
    spread = base_deviations(rig)
    cases = [p | flat(name, left_out(rig, name, truth[name])) for name in truth]
    cases += [p | {name: p[name] + 0.5 * deviation} for name, deviation in spread.items()]
    nudges = [
        (name, parameter, nudge(rig, name, parameter, v)) for name in truth for parameter, v in truth[name].items()
    ]
    cases += [p | {f"{name}.{parameter}": truth[name][parameter] + by} for name, parameter, by in nudges]
    columns = innovations(rig, p, cases, given)
    missing, changes = columns[:, : len(truth)], columns[:, len(truth) :].copy()
    changes[:, : len(spread)] *= 2.0  # of one standard deviation
    found = {}
    for k, name in enumerate(truth):
        own = [len(spread) + n for n, (other, _, _) in enumerate(nudges) if other == name]
        found[name] = 0.5 * remaining(missing[:, k], np.delete(changes, own, axis=1), len(spread))
    return found


def remaining(what: np.ndarray, free: np.ndarray, with_prior: int) -> float:
    """Return the squared distance of `what` from the best combination of `free`.

    The first `with_prior` coefficients have a standard normal prior, which adds their squares.
    """
    prior = np.eye(with_prior, free.shape[1])
    scale = np.sqrt(np.sum(free**2, axis=0)) + 1e-300
    rows, target = np.vstack([free, prior]) / scale, np.append(what, np.zeros(with_prior))
    best = np.linalg.lstsq(rows, target)[0]
    return float(np.sum((target - rows @ best) ** 2))


def base_deviations(rig: Rig) -> Values:
    """Return the standard deviation of each base parameter: half its tolerance."""
    return {name: 0.5 * share * abs(value) for name, (value, share) in rig.sheet.items()}


def flat(name: str, values: Mapping[str, float]) -> Values:
    """Return the parameters of an effect by full name, as for `bind`."""
    return {f"{name}.{p}": v for p, v in values.items()}


def left_out(rig: Rig, name: str, values: Values) -> Values:
    """Return the parameters of an effect at neutral."""
    return {**rig.entries, **rig.outside}[name].left_out(values)


def nudge(rig: Rig, name: str, parameter: str, value: float) -> float:
    """Return a small step of an effect's parameter: 5 % of its distance from neutral, or of its value for a shape."""
    entry = {**rig.entries, **rig.outside}[name]
    return 0.05 * (value if parameter in entry.shape or entry.inverse else value - entry.neutral) or 1e-9


def innovations(rig: Rig, p: Values, cases: Sequence[Values], given: Conditions) -> np.ndarray:
    """Return the whitened innovations of the true run under models with other parameters, a column per model.

    With parameters `p` they are 0.
    """
    return _Filter(rig, p, cases, given).whitened()


class _Filter:
    """Extended Kalman filter with the gains of the true model, run on all logs and for all cases at once.

    Arrays are (…, logs, columns). The columns are the true run, the cases, and the true run with each state a little
    above and below, for the Jacobians. Additional states are the pushes, and earlier readings of a late sensor.
    """

    def __init__(self, rig: Rig, p: Values, cases: Sequence[Values], given: Conditions) -> None:
        self.rig, self.given, self.cases = rig, given, len(cases)
        names = {name.partition(".")[0] for case in (p, *cases) for name in case}
        self.scales = rig.scales(names)
        self.n, self.q = self.scales.size, len(rig.pushes)
        moved = self.n + self.q
        everyone = [p, *cases, *[p] * (2 * moved)]
        keys = {key for case in everyone for key in case}
        self.numbers: dict[str, Any] = {}
        for key in sorted(keys):
            neutral = self._neutral(key, everyone)
            values = np.array([case.get(key, neutral) for case in everyone])
            self.numbers[key] = values[None, :] if np.ptp(values) else float(values[0])
        self.rate, self.look = rig.bind(Arrays, self.numbers)
        self.actings = self._actings(everyone)
        late = [name for name, s in rig.sensors.items() if s.kind == "late"]
        outputs = list(rig.outputs)
        self.late = outputs.index(rig.sensors[late[0]].output) if late else None
        values = np.array([case.get(f"{late[0]}.value", 0.0) for case in everyone]) if late else np.zeros(len(everyone))
        self.latency = values[: 1 + self.cases] / rig.step  # in rows
        self.registers = math.ceil(float(self.latency.max())) + 1 if self.latency.max() > 0.0 else 0

    def _neutral(self, key: str, everyone: Sequence[Values]) -> float:
        """Return the neutral value of a parameter, for a case without its effect."""
        name, _, parameter = key.partition(".")
        having = next(case[key] for case in everyone if key in case)
        return left_out(self.rig, name, {parameter: having})[parameter] if parameter else having

    def _actings(self, everyone: Sequence[Values]) -> np.ndarray:
        """Return the acting commands (after delay, play and such), shape (rows, parts, inputs, logs, columns)."""
        made: dict[Any, np.ndarray] = {}
        for case in everyone:
            key = shaping(self.rig, case)
            if key not in made:
                made[key] = np.stack(
                    [self.rig.acting(case, run, self.rig.substeps) for run in self.given.runs], axis=-1
                )
        return np.stack([made[shaping(self.rig, case)] for case in everyone], axis=-1)

    def whitened(self) -> np.ndarray:
        rig, n, q, cases = self.rig, self.n, self.q, self.cases
        logs, count = len(self.given.runs), len(self.given.runs[0].times)
        extra, size = self.registers, n + q + self.registers
        runs, outputs = self.given.runs, len(rig.outputs)
        width, first = 1 + cases, 1 + cases  # of the true run and the cases; first column of the Jacobians
        steps = np.concatenate([1e-5 * self.scales, 1e-3 * np.maximum(self.given.push_deviations, 1e-12)])
        x = np.zeros((n, logs, first + 2 * (n + q)))
        names = {key.partition(".")[0] for key in self.numbers}
        for log, run in enumerate(runs):
            x[:, log, :] = rig.first_state(names, run)[:, None]
        d = np.zeros((q, logs, x.shape[2]))
        deviations = np.array(self.given.push_deviations)
        keep = math.exp(-rig.step / rig.correlation_time)
        cov = np.zeros((logs, size, size))
        cov[:] = np.diag(np.concatenate([(0.3 * self.scales) ** 2, deviations**2, np.full(extra, 1e-12)]))
        noise = np.zeros((size, size))
        noise[n : n + q, n : n + q] = np.diag((1.0 - keep**2) * deviations**2)
        times = np.stack([run.times for run in runs], axis=-1)
        variance = np.stack(list(self.given.variances), axis=1)  # (rows, logs, outputs)
        variance = np.where(np.isfinite(variance), variance, 1e12 * np.array(list(rig.outputs.values())) ** 2)
        seen = None  # registers: what the late sensor has read, newest first
        white = np.empty((count, logs, outputs, cases))
        transition = np.zeros((logs, size, size))
        transition[:, range(n, n + q), range(n, n + q)] = keep
        for k in range(count):
            t = times[k][:, None]
            # up and down, about the true run
            x[:, :, first:] = x[:, :, :1]
            d[:, :, first:] = d[:, :, :1]
            for i in range(n + q):
                part, j = (x, i) if i < n else (d, i - n)
                part[j, :, first + 2 * i] += steps[i]
                part[j, :, first + 2 * i + 1] -= steps[i]
            right = [np.broadcast_to(v, x.shape[1:]) for v in self.look(t, x, d)]
            y = np.stack(
                [
                    np.broadcast_to(rig.sensed(self.numbers, o, v), x.shape[1:])
                    for o, v in zip(rig.outputs, right, strict=True)
                ]
            )
            h = np.zeros((logs, outputs, size))
            h[:, :, : n + q] = ((y[:, :, first::2] - y[:, :, first + 1 :: 2]) / (2.0 * steps)).transpose(1, 0, 2)
            y = y[:, :, :width]
            newest = None
            if extra and self.late is not None:
                newest, slope = y[self.late].copy(), h[:, self.late].copy()
                if seen is None:
                    seen = np.repeat(newest[None], extra, axis=0)
                y = y.copy()
                y[self.late], h[:, self.late] = self._looked_back(newest, slope, seen)
            cross = cov @ h.transpose(0, 2, 1)
            spread = h @ cross + variance[k][:, :, None] * np.eye(outputs)
            gain = np.linalg.solve(spread, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
            gap = (y[:, :, :1] - y[:, :, 1:]).transpose(1, 0, 2)  # (logs, outputs, cases)
            white[k] = np.linalg.solve(np.linalg.cholesky(spread), gap)
            change = (gain @ gap).transpose(1, 0, 2)
            x[:, :, 1:width] += change[:n]
            d[:, :, 1:width] += change[n : n + q]
            cov = cov - gain @ cross.transpose(0, 2, 1)
            cov = 0.5 * (cov + cov.transpose(0, 2, 1))
            if k + 1 == count:
                break
            if extra and seen is not None and newest is not None:
                seen[:, :, 1:] += change[n + q :]
                newest[:, 1:] += np.einsum("li,ilc->lc", slope[:, : n + q], change[: n + q])
                seen = np.concatenate([newest[None], seen[:-1]])
                transition[:, n + q, :] = slope
                transition[:, range(n + q + 1, size), range(n + q, size - 1)] = 1.0
            x = self._step(times[k], times[k + 1] - times[k], x, d, self.actings[k])
            moved = (x[:, :, first::2] - x[:, :, first + 1 :: 2]) / (2.0 * steps)
            transition[:, :n, : n + q] = moved.transpose(1, 0, 2)
            d *= keep
            cov = transition @ cov @ transition.transpose(0, 2, 1) + noise
        return white.reshape(-1, cases)

    def _looked_back(self, newest: np.ndarray, slope: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the late reading of each column, interpolated between past rows, and the true run's row of H."""
        history = np.concatenate([newest[None], seen])
        whole = np.minimum(self.latency.astype(int), history.shape[0] - 2)
        part = self.latency - whole
        columns = np.arange(self.latency.size)
        before, after = history[whole, :, columns].T, history[whole + 1, :, columns].T
        row = np.zeros_like(slope)
        own = slope.shape[1] - self.registers
        for place, weight in ((whole[0], 1.0 - part[0]), (whole[0] + 1, part[0])):
            row += weight * slope if place == 0 else 0.0
            if place:
                row[:, own + place - 1] += weight
        return (1.0 - part) * before + part * after, row

    def _step(self, t: np.ndarray, step: np.ndarray, x: np.ndarray, d: np.ndarray, acting: np.ndarray) -> np.ndarray:
        """Return the states after a row, by Runge-Kutta in the rig's substeps."""
        parts = self.rig.substeps
        h = (step / parts)[:, None]
        for part in range(parts):
            now, u = (t + part * step / parts)[:, None], acting[part]

            def slopes(at: Any, state: np.ndarray, u: np.ndarray = u) -> np.ndarray:
                return np.stack([np.broadcast_to(v, state.shape[1:]) for v in self.rate(at, state, u, d)])

            k1 = slopes(now, x)
            k2 = slopes(now + 0.5 * h, x + 0.5 * h * k1)
            k3 = slopes(now + 0.5 * h, x + 0.5 * h * k2)
            k4 = slopes(now + h, x + h * k3)
            x = x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return x


def shaping(rig: Rig, p: Flat) -> tuple[float, ...]:
    """Return the parameters that shape the acting commands."""
    return tuple(float(p.get(name, 0.0)) for name in rig.shaping)


def distribution(seeds: Iterator[int]) -> str:
    """Return a table of the costs of effects in known studies, with the number of effects sized by their cost."""
    from tests.blind.field_study import LEAST, RIGS, draw  # it draws by the costs

    sized: list[float] = []
    drawn: list[float] = []
    by_effect: dict[str, list[float]] = defaultdict(list)
    for seed in seeds:
        study = draw(seed)
        for name, cost in study.costs.items():
            if study.kind == "known":
                (drawn if RIGS[study.plant].entries[name].fixed else sized).append(cost)
                by_effect[f"{study.plant}: {name}"].append(cost)
    if not by_effect:
        return "no known study among them"
    every = np.array(sized + drawn)
    lines = [f"{name:36} {len(c):3d}  {min(c):9.0f} … {max(c):9.0f}" for name, c in sorted(by_effect.items())]
    quantiles = np.percentile(every, (0, 10, 25, 50, 75, 90, 100))
    lines.append(f"{every.size} effects, {len(drawn)} of them of a drawn size; least {LEAST:g} nats wanted")
    lines.append("0, 10, 25, 50, 75, 90, 100 %: " + ", ".join(f"{q:.0f}" for q in quantiles) + " nats")
    lines.append(f"below 100 nats: {100 * np.mean(every < 100.0):.0f} %; below 20: {np.sum(every < LEAST):d}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.blind.field_cost", description=__doc__.splitlines()[0])
    parser.add_argument("count", type=int, metavar="N", help="how many seeds")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    options = parser.parse_args(arguments)
    print(distribution(iter(range(options.first, options.first + options.count))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
