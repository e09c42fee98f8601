"""Truth of the FMUs' blind suite: the general catalogue of effects at places, and integration in small steps.

Nothing of the project is used, and of the C sources of the FMUs only the tables of variables. A plant (`fmu_truths.py`)
declares its places: inputs, position-velocity pairs, storages, outputs. From these follow its effects, named
`{kind}_at_{place}`. Runs are integrated by Runge-Kutta with a few steps a row; a test compares with DOP853.

| effect | parameters | acts |
|---|---|---|
| `bias`, `gain` at u | value | u + value, u · value |
| `dead_band`, `saturation` at u | width, limit | nothing within ±width, the rest less width; ±limit |
| `rate_limit`, `play` at u | rate, width | per second; ±width |
| `lag`, `second_order_lag` at u | time; frequency [rad/s], damping | |
| `delay` | time | all inputs |
| `coulomb` at v | level | −level·tanh(v/ε), ε a fiftieth of a usual speed |
| `stribeck` at v | level, breakaway, speed | −(level + (breakaway − level)·exp(−(v/speed)²))·tanh(v/ε) |
| `viscous`, `quadratic_drag` at v | coefficient | −coefficient·v, −coefficient·v·|v| |
| `cogging` at v | sine, cosine, period | −sine·sin(2πq/period) − cosine·cos(2πq/period) |
| `cubic_spring` at v | stiffness | −stiffness·q³ |
| `leak` at s | coefficient | s' less coefficient·s |
| `overflow` at s | level, coefficient | s' less coefficient·max(s − level, 0) |
| `bias`, `scale`, `latency` at y | value | y + value, y · value, y(t − value) |
| `lag`, `drift` at y | time; rate | y + rate·t |
"""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from tests.blind.field_rig import (
    Array,
    Course,
    Entry,
    Flat,
    Floats,
    Look,
    Rate,
    Rig,
    Run,
    hidden_in,
    laws_in,
    sensor,
)
from tests.blind.fmu_build import PLANTS

ModelExchange, CoSimulation = "model_exchange", "co_simulation"
PARTS = 4  # Runge-Kutta steps of a row
SHORTEST_LAG = 0.5  # time constant of a sensor in rows, below which the integration would be wrong
DAMPING = {"damping": (0.4, 0.8)}
QUICK = 50.0  # a lag so many times faster than a part of a row is none


def place(name: str) -> str:
    """Return the name of a place: every character except letters, digits and _ becomes _."""
    return re.sub(r"\W", "_", name)


@dataclass(frozen=True)
class Input:
    """Input of a plant: value at rest, range of the commands, shortest and longest hold [s], kinds of effects."""

    rest: float
    low: float
    high: float
    holds: tuple[float, float]
    kinds: str = ""

    @property
    def reach(self) -> float:
        """Return the largest distance of a command from 0."""
        return max(abs(self.low), abs(self.high))

    def effects(self, _: str, rig: Rig) -> dict[str, Entry]:
        """Return the effects that an input may have."""
        h, reach = rig.step, self.reach
        return {
            "bias": Entry("value", 0.02 * reach, 5e-4 * reach, 0.3 * reach, signed=True),
            "gain": Entry("value", 0.03, 1e-3, 0.4, signed=True, neutral=1.0),
            "dead_band": Entry("width", 0.03 * reach, 1e-3 * reach, 0.3 * reach),
            "saturation": Entry("limit", 0.1, 0.01, 0.6, neutral=reach, ratio={"limit": (-reach, -reach)}),
            "rate_limit": Entry("rate", 4.0 * h / reach, h / reach, 100.0 * h / reach, inverse=True),
            "play": Entry("width", 0.03 * reach, 1e-3 * reach, 0.3 * reach),
            "lag": Entry("time", h, 0.05 * h, 30.0 * h),
            "second_order_lag": Entry("frequency", h, 0.1 * h, 20.0 * h, shape=DAMPING, inverse=True),
        }


@dataclass(frozen=True)
class Pair:
    """Velocity with its position: usual force, speed and distance, and kinds of effects.

    port:    an input is a force at this velocity, hence effects act in co-simulation too
    inertia: parameter by which a force is divided where the claim is a rate; without it the claim is a force
    period:  range of the cogging's period
    """

    force: float
    speed: float
    distance: float
    kinds: str
    port: bool = False
    inertia: str = ""
    period: tuple[float, float] = (1.0, 1.0)

    def effects(self, *_: Any) -> dict[str, Entry]:
        """Return the effects that a velocity may have; a parameter is a share of the usual force over a unit."""

        def force(names: str, unit: float, **more: Any) -> Entry:
            return Entry(names, 0.02 * self.force / unit, 2e-4 * self.force / unit, 0.5 * self.force / unit, **more)

        slow = {"speed": (0.2 * self.speed, 0.5 * self.speed)}
        return {
            "coulomb": force("level", 1.0),
            "stribeck": force("breakaway", 1.0, ratio={"level": (0.2, 0.4)}, shape=slow),
            "viscous": force("coefficient", self.speed),
            "quadratic_drag": force("coefficient", self.speed**2),
            "cogging": force("sine cosine", 1.0, shape={"period": self.period}),
            "cubic_spring": force("stiffness", self.distance**3),
        }


@dataclass(frozen=True)
class Storage:
    """Stored quantity: usual value, level of overflow, usual rate, and kinds of effects."""

    value: float
    level: float
    rate: float
    kinds: str

    def effects(self, *_: Any) -> dict[str, Entry]:
        """Return the effects that a storage may have."""
        usual, high = self.rate / self.value, self.rate / (0.1 * self.value)
        return {
            "leak": Entry("coefficient", 0.05 * usual, 1e-4 * usual, usual),
            "overflow": Entry("coefficient", high, 0.01 * high, 100.0 * high, shape={"level": (self.level,) * 2}),
        }


@dataclass(frozen=True)
class Output:
    """Output: number of the state that it shows, noise, usual spread, and kinds of errors."""

    state: int
    noise: float
    spread: float
    kinds: str

    def effects(self, name: str, rig: Rig) -> dict[str, Entry]:
        """Return the errors that an output may have."""
        h, slow = rig.step, self.spread / (rig.rows * rig.step)
        return {
            "bias": sensor(name, "bias", self.noise, 0.02 * self.noise, 0.3 * self.spread),
            "scale": sensor(name, "scale", 0.02, 5e-4, 0.3),
            "lag": Entry("time", h, SHORTEST_LAG * h, 15.0 * h, output=name, error="lag"),
            "drift": Entry("rate", 0.02 * slow, 5e-4 * slow, 0.5 * slow, signed=True, output=name, error="drift"),
            "latency": sensor(name, "late", 2.0 * h, 1.5 * h, 4.0 * h),
        }


class FmuRig(Rig):
    """Plant of the FMUs' suite: places, equations, and what can be hidden in it for a way of simulation."""

    plants_inputs: dict[str, Input]
    pairs: dict[str, Pair] = {}
    storages: dict[str, Storage] = {}
    plants_outputs: dict[str, Output]
    strangers: dict[str, Entry]
    preroll_rows: int = 60
    rest_rows = 10

    def __init__(self, way: str) -> None:
        self.way, plant = way, PLANTS[self.name]
        self.sheet = {place(v.name): (v.start, v.tolerance) for v in plant.parameters}
        self.rest = [v.start for v in plant.states]
        self.inputs = {name: u.rest for name, u in self.plants_inputs.items()}
        self.manoeuvres = tuple((u.low, u.high, u.holds) for u in self.plants_inputs.values())
        self.outputs = {name: y.noise for name, y in self.plants_outputs.items()}
        self.preroll = self.preroll_rows * self.step
        at_inputs = {"delay": Entry("time", 0.5 * self.step, 0.02 * self.step, 20.0 * self.step)}
        at_inputs |= self.effects_at(self.plants_inputs)
        ported = self.effects_at({name: v for name, v in self.pairs.items() if v.port})
        internal = self.effects_at({name: v for name, v in self.pairs.items() if not v.port} | self.storages)
        first = next(iter(self.plants_inputs))
        self.outside = self.strangers | _of_time(place(first), self.plants_inputs[first], self.step * self.rows)
        self.entries = at_inputs | ported | self.effects_at(self.plants_outputs)
        self.entries |= internal if way == ModelExchange else {}
        self.outside |= internal if way == CoSimulation else {}
        self.own_states = {
            f"lag_at_{place(name)}": {f"lag_at_{place(name)}.state": self.rest[y.state]}
            for name, y in self.plants_outputs.items()
            if "lag" in y.kinds.split()
        }
        parameters = {name: (*entry.names.split(), *entry.shape) for name, entry in at_inputs.items()}
        self.shaping = tuple(f"{name}.{p}" for name, given in parameters.items() for p in given)
        places = [*map(place, self.inputs), *self.pairs, *self.storages, *map(place, self.outputs)]
        alike = [{name for name in self.entries if name.endswith(f"_at_{p}")} for p in places]
        slow = {n for n in at_inputs if n == "delay" or n.startswith(("lag_", "second_order", "rate_limit", "play"))}
        self.families = tuple(map(frozenset, (*alike, slow)))

    def effects_at(self, places: Mapping[str, Any]) -> dict[str, Entry]:
        """Return the effects of places by name."""
        kinds = [(kind, name) for name, at in places.items() for kind in at.kinds.split()]
        return {f"{kind}_at_{place(name)}": places[name].effects(name, self)[kind] for kind, name in kinds}

    # -- equations ------------------------------------------------------------------------------------

    def equations(self, f: Any, p: Flat, acts: Callable[..., Any], hidden: Callable[..., Any]) -> Rate:
        """Return the derivatives of the plant's own states.

        Args:
            f: math functions, `Floats` or `Arrays`.
            p: parameters.
            acts: (pair, position, velocity) → force against the motion, (storage, value) → its loss per second.
            hidden: (stranger, term) → the term for its parameters, 0 without it.
        """
        raise NotImplementedError

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return derivatives and outputs, with the hidden effects of `p`."""
        hidden, first = hidden_in(p), place(next(iter(self.plants_inputs)))
        own = self.equations(f, p, self._acts(f, p), hidden)
        names = {key.partition(".")[0] for key in p}
        lagged = [place(name) for name in self.plants_outputs if f"lag_at_{place(name)}" in names]
        number = {at: len(self.states) + k for k, at in enumerate(lagged)}
        time = {at: p[f"lag_at_{at}.time"] for at in lagged}
        state = {place(name): y.state for name, y in self.plants_outputs.items()}
        drifts = {at: p.get(f"drift_at_{at}.rate", 0.0) for at in state}
        least = SHORTEST_LAG * self.step  # so that a lag of 0 does no harm where others have one
        changing = any(name.endswith(f"_at_{first}") for name in names & set(self.outside))

        def rate(t: float, x: Any, u: Any, push: Any) -> list[Any]:
            acting = [_at_time(f, hidden, first, t, u[0]), *u[1:]] if changing else u
            lags = [(x[state[at]] - x[k]) / f.maximum(time[at], least) for at, k in number.items()]
            return [*own(t, x, acting, push), *lags]

        def look(t: float, x: Any, push: Any) -> list[Any]:
            shown = {at: x[k] for at, k in state.items()}
            shown |= {at: f.where(time[at] > 0.0, x[k], shown[at]) for at, k in number.items()}
            return [value + drifts[at] * t for at, value in shown.items()]

        return rate, look

    def _acts(self, f: Any, p: Flat) -> Callable[..., Any]:
        """Return (place, values) → sum of the effects at a velocity or a storage."""
        creep = {name: v.speed / 50.0 for name, v in self.pairs.items()}
        places = (*self.pairs, *self.storages)
        terms = {at: laws_in(p, {f"{kind}_at_{at}": law for kind, law in LAWS.items()}) for at in places}

        def acts(name: str, *at: Any) -> Any:
            way = (f.tanh(at[1] / creep[name]),) if name in creep else ()
            return sum(law(f, *at, *way) for law in terms[name])

        return acts

    def resolves(self, truth: Mapping[str, Mapping[str, float]]) -> bool:
        """Return whether the integration resolves the lag of every sensor."""
        least = SHORTEST_LAG * self.step
        return all(values["time"] >= least for name, values in truth.items() if name in self.own_states)

    def first_state(self, names: Collection[str], run: Run) -> Array:
        """Return the start state; a lagging sensor begins at what it shows."""
        lags = [y.state for name, y in self.plants_outputs.items() if f"lag_at_{place(name)}" in names]
        return np.concatenate([run.start, run.start[lags]])

    # -- inputs ---------------------------------------------------------------------------------------

    def acting(self, p: Flat, run: Run, parts: int) -> Array:
        """Return the mean acting inputs of each of `parts` parts of a row, shape (rows, parts, inputs)."""
        columns = []
        for number, (name, u) in enumerate(self.plants_inputs.items()):
            at = _parameters(p, place(name))
            still = _static(np.append(u.rest, run.commands[:, number]), at)
            delayed = _delayed(still, float(p.get("delay.time", 0.0)) / self.step, parts)
            columns.append(_slow(delayed, still[0], at, self.step / parts))
        return np.stack(columns, axis=-1).reshape(len(run.times), parts, -1)

    def course(
        self, p: Mapping[str, float], run: Run, resets: Mapping[int, Array] | None = None, parts: int = PARTS
    ) -> Course:
        """Return the simulated log: `parts` Runge-Kutta steps a row, after a preroll at rest commands.

        Args:
            p: parameters.
            run: inputs, and the state at the begin of the preroll.
            resets: row → new state.
            parts: steps of a row.
        """
        rate, look = self.bind(Floats, p)
        h, lead = self.step / parts, self.preroll_rows
        rest = [float(_static(np.array([u.rest]), _parameters(p, place(n)))[0]) for n, u in self.plants_inputs.items()]
        acting = [rest] * (lead * parts) + self.acting(p, run, parts).reshape(-1, len(rest)).tolist()
        rows, begin = len(run.times), float(run.times[0])
        state = self.first_state({name.partition(".")[0] for name in p}, run).tolist()
        states, fine = np.empty((rows, len(state))), np.empty((len(acting), len(self.outputs)))
        moments = begin + h * (np.arange(len(acting)) - lead * parts)
        for k, (t, u) in enumerate(zip(moments.tolist(), acting, strict=True)):
            row, part = k // parts - lead, k % parts
            push = run.pushes[max(row, 0)]
            if part == 0 and row >= 0:
                state = list((resets or {}).get(row, state))
                states[row] = state
            fine[k] = look(t, state, push)
            state = _runge_kutta(rate, t, state, u, push, h)
        if not np.all(np.isfinite(states)):
            raise ArithmeticError(f"{self.name}: states are not finite")
        readings = fine[lead * parts :: parts].copy()
        late, late_output = self.late()
        if f"{late}.value" in p:
            number = list(self.outputs).index(late_output)
            readings[:, number] = np.interp(run.times - p[f"{late}.value"], moments, fine[:, number])
        return Course(self.all_sensed(p, readings), states)


# (functions, position, velocity, direction, parameters) → force against the motion; (…, value, …) → loss of a storage
LAWS: dict[str, Callable[..., Any]] = {
    "coulomb": lambda f, q, v, way, level: level * way,
    "stribeck": lambda f, q, v, way, level, breakaway, speed: (
        (level + (breakaway - level) * f.exp(-((v / speed) ** 2))) * way
    ),
    "viscous": lambda f, q, v, way, coefficient: coefficient * v,
    "quadratic_drag": lambda f, q, v, way, coefficient: coefficient * v * f.absolute(v),
    "cogging": lambda f, q, v, way, sine, cosine, period: (
        sine * f.sin(2.0 * math.pi / period * q) + cosine * f.cos(2.0 * math.pi / period * q)
    ),
    "cubic_spring": lambda f, q, v, way, stiffness: stiffness * q**3,
    "leak": lambda f, x, coefficient: coefficient * x,
    "overflow": lambda f, x, coefficient, level: coefficient * f.maximum(x - level, 0.0),
}


def _parameters(p: Flat, at: str) -> dict[str, float]:
    """Return the parameters of the effects at an input, without the place in their names."""
    return {
        key.replace(f"_at_{at}.", "."): float(value)
        for key, value in p.items()
        if key.partition(".")[0].endswith(f"_at_{at}")
    }


def _static(u: Array, at: Mapping[str, float]) -> Array:
    """Return commands after gain, bias, dead band, saturation and play."""
    v = at.get("gain.value", 1.0) * u + at.get("bias.value", 0.0)
    v = np.sign(v) * np.maximum(np.abs(v) - at.get("dead_band.width", 0.0), 0.0)
    limit, width = at.get("saturation.limit", math.inf), at.get("play.width", 0.0)
    v = np.clip(v, -limit, limit)
    if width > 0.0:
        held, last = np.empty_like(v), v[0]
        for k, value in enumerate(v):
            held[k] = last = min(max(last, value - width), value + width)
        return held
    return v


def _delayed(u: Array, rows: float, parts: int) -> Array:
    """Return the means over parts of rows of a held signal; its first value has been there for ever."""
    edges = np.arange((u.size - 1) * parts + 1) / parts - rows
    total = np.concatenate([[0.0], np.cumsum(u[1:])])
    area = np.where(edges < 0.0, edges * u[0], np.interp(edges, np.arange(u.size), total))
    return np.diff(area) * parts


def _slow(u: Array, rest: float, at: Mapping[str, float], h: float) -> Array:
    """Return the means over parts of `h` seconds after rate limit and lags."""
    if (rate := at.get("rate_limit.rate", math.inf)) * h < 10.0 * np.ptp(np.append(u, rest)):
        means, last = np.empty_like(u), rest
        for k, value in enumerate(u):
            gap = value - last
            if abs(gap) <= rate * h:
                means[k], last = value - gap * abs(gap) / (2.0 * rate * h), value
            else:
                moved = math.copysign(rate * h, gap)
                means[k], last = last + 0.5 * moved, last + moved
        u = means
    if (time := at.get("lag.time", 0.0)) * QUICK > h:
        u = _filtered(u, rest, np.array([[-1.0 / time]]), np.array([1.0 / time]), h)
    if (w := at.get("second_order_lag.frequency", math.inf)) * h < QUICK:
        damping = at["second_order_lag.damping"]
        u = _filtered(u, rest, np.array([[0.0, 1.0], [-w * w, -2.0 * damping * w]]), np.array([0.0, w * w]), h)
    return u


def _filtered(u: Array, rest: float, a: Array, b: Array, h: float) -> Array:
    """Return the means over parts of the first state of x' = a·x + b·u, from rest."""
    n = len(b)
    whole = np.zeros((n + 2, n + 2))  # states, input, integral of the first state
    whole[:n, :n], whole[:n, n], whole[n + 1, 0] = a, b, 1.0
    step = expm(whole * h)
    x, means = np.array([rest, *[0.0] * (n - 1)]), np.empty_like(u)
    for k, value in enumerate(u):
        means[k] = (step[n + 1, :n] @ x + step[n + 1, n] * value) / h
        x = step[:n, :n] @ x + step[:n, n] * value
    return means


def _of_time(at: str, u: Input, duration: float) -> dict[str, Entry]:
    """Return effects at an input that depend on time, which no catalogue has."""
    some, reach = 0.5 * (u.holds[0] + u.holds[1]), u.reach
    now_and_then = {"period": (0.15 * duration, 0.25 * duration), "share": (0.2, 0.4)}
    return {
        f"hunting_at_{at}": Entry("depth", 0.05, 2e-3, 0.6, shape={"frequency": (0.3 / some, 1.0 / some)}),
        f"tiring_at_{at}": Entry("share", 0.1, 5e-3, 0.8, shape={"time": (0.2 * duration, 0.5 * duration)}),
        f"gusts_at_{at}": Entry("size", 0.03 * reach, 1e-3 * reach, 0.4 * reach, shape=now_and_then),
    }


def _at_time(f: Any, hidden: Any, at: str, t: Any, u: Any) -> Any:
    """Return an input with the effects of `_of_time`."""
    hunting = hidden(f"hunting_at_{at}", lambda depth, frequency: depth * f.sin(2.0 * math.pi * frequency * t))
    tired = hidden(f"tiring_at_{at}", lambda share, time: share * (1.0 - f.exp(-t / time)))
    u = u * (1.0 + hunting) * (1.0 - tired)
    return u + hidden(
        f"gusts_at_{at}", lambda size, period, share: f.where(t % period < share * period, 1.0, 0.0) * size
    )


def _runge_kutta(rate: Rate, t: float, x: list[float], u: Any, push: Any, h: float) -> list[float]:
    k1 = rate(t, x, u, push)
    k2 = rate(t + 0.5 * h, [a + 0.5 * h * b for a, b in zip(x, k1, strict=True)], u, push)
    k3 = rate(t + 0.5 * h, [a + 0.5 * h * b for a, b in zip(x, k2, strict=True)], u, push)
    k4 = rate(t + h, [a + h * b for a, b in zip(x, k3, strict=True)], u, push)
    return [a + h / 6.0 * (b + 2.0 * (c + d) + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)]
