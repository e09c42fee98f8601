"""The general catalogue of terms for inputs, position-velocity pairs, storage states and sensors of an FMU."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

from cosim.model.effects import Delay
from cosim.model.model import Number, Values
from cosim.model.namespaces import Namespace
from cosim.model.quantities import Quantity, parameter
from cosim.model.sensors import Bias, Drift, Lag, Latency, Magnitude, Scale
from cosim.terms.language import Force, InputTerm, Place, RateTerm, RememberingTerm, bind, scaled, scaled_size

BEGUN = Quantity("begun", "1", "whether the memory is initialized")
SOFTNESS = scaled("v", default=0.02, typical=0.01, low=1e-4, high=0.2, doc="velocity ε of the transition")
MIN_LAG_SHARE = 1e-3  # minimum time constant of a lag, as a share of a substep; a smaller one is ignored

# -- at an input -----------------------------------------------------------------------------------


InputBias = InputTerm.named(
    "bias",
    equation="u + b in place of u",
    value=scaled_size("u", typical=0.05, low=-2.0, high=2.0, doc="offset b"),
    change=lambda e, m, u: u + e.value,
)
InputGain = InputTerm.named(
    "gain",
    equation="k·u in place of u",
    value=scaled("1", default=1.0, neutral=1.0, typical=0.1, low=0.05, high=10.0, doc="gain k"),
    change=lambda e, m, u: e.value * u,
)
DeadBand = InputTerm.named(
    "dead_band",
    equation="u − clip(u, ±w) in place of u",
    width=scaled_size("u", typical=0.1, low=0.0, high=2.0, doc="half width w"),
    change=lambda e, m, u: u - m.clip(u, -e.width, e.width),
)
SquareLaw = InputTerm.named(  # like the thrust of a propeller or the flow through a valve
    "square_law",
    equation="(1 − s)·u + s·u·|u|/M in place of u, M the largest |u|",
    share=scaled_size("1", typical=0.3, low=-1.0, high=1.0, doc="share s of the square"),
    change=lambda e, m, u: u + e.share * u * (m.sqrt(u * u) / e.place.sizes.get("M", 1.0) - 1.0),
)


class Saturation(InputTerm):
    """Saturation of an input at ±1/i. With a limit above the largest input of the logs, the term has no effect."""

    kind = "saturation"
    equation = "clip(u, ±1/i) in place of u"

    inverse_limit: float = scaled(
        "1/M", default=1.0, neutral=1.0, typical=0.2, low=1.0, high=10.0, doc="inverse i of the limit"
    )

    def change(self, m: Namespace, value: Number) -> Number:
        """Return clip(u, ±1/i)."""
        least = 1.0 / self.place.sizes.get("M", 1.0)
        limit = 1.0 / m.maximum(self.inverse_limit, least)
        return m.where(self.inverse_limit > (1.0 + 1e-9) * least, m.clip(value, -limit, limit), value)


class RateLimit(RememberingTerm):
    """Limit of the rate of an input."""

    kind = "rate_limit"
    equation = "u follows with at most 1/i per second"
    memory = (Quantity("value", "1", "input after the limit"), BEGUN)

    inverse_rate: float = scaled_size("T/u", typical=1.0, low=0.0, high=1000.0, doc="inverse i of the rate")

    def advance(self, m: Namespace, h: Number, value: Number, memory: Values) -> tuple[Number, Values]:
        """Return the changed input's mean over the substep and its final value; exact for a constant input."""
        pace = m.maximum(self.inverse_rate, 1e-6 / self.place.sizes["u"])
        moved = m.clip(value - memory[0], -h / pace, h / pace)
        end = memory[0] + moved
        mean = end - moved * m.sqrt(moved * moved) * pace / (2.0 * h)
        return m.where(self.inverse_rate > 0.0, mean, value), (m.where(self.inverse_rate > 0.0, end, value),)


class Play(RememberingTerm):
    """Play (backlash) of an input."""

    kind = "play"
    equation = "p ← clip(p, u ± w), p in place of u"
    memory = (Quantity("value", "1", "input after the play"), BEGUN)

    width: float = scaled_size("u", typical=0.1, low=0.0, high=2.0, doc="half width w")

    def advance(self, m: Namespace, h: Number, value: Number, memory: Values) -> tuple[Number, Values]:
        """Return the position p of the play, clip(p, u ± w), as changed input and as new memory."""
        after = m.clip(memory[0], value - self.width, value + self.width)
        return after, (after,)


class InputLag(RememberingTerm):
    """First-order lag of an input."""

    kind = "lag"
    equation = "T·u̇ₗ = u − uₗ, uₗ in place of u"
    memory = (Quantity("value", "1", "input after the lag"), BEGUN)

    time: float = scaled_size("T", typical=3.0, low=0.0, high=1000.0, doc="time constant T")

    def advance(self, m: Namespace, h: Number, value: Number, memory: Values) -> tuple[Number, Values]:
        """Return the mean over the substep, and the value at its end; exact for a constant input."""
        acts, slow = self.time > MIN_LAG_SHARE * h, m.maximum(self.time, MIN_LAG_SHARE * h)
        share, before = m.exp(-h / slow), memory[0]
        end = value + (before - value) * share
        mean = value + (before - value) * (1.0 - share) * slow / h
        return m.where(acts, mean, value), (m.where(acts, end, value),)


class SecondOrderLag(RememberingTerm):
    """Second-order lag of an input.

    With the deviation p of u₂ from u and r = h/T, p and s = T·ṗ after a substep h are

        p·c + (ζ·p + s)·σ    s·c − (ζ·s + p)·σ    c, σ = e^(−ζr)·cos wr, e^(−ζr)·sin(wr)/w    w = √(1 − ζ²)

    with cosh and sinh for ζ > 1. The mean follows from the integrated equation.
    """

    kind = "second_order_lag"
    equation = "T²·ü₂ + 2·ζ·T·u̇₂ + u₂ = u, u₂ in place of u"
    memory = (
        Quantity("value", "1", "input after the lag"),
        Quantity("ahead", "1", "value plus T·rate"),
        BEGUN,
    )
    starts = ({"time": 2.0, "damping": 0.5}, {"time": 6.0, "damping": 0.7}, {"time": 20.0, "damping": 0.7})

    time: float = scaled_size("T", typical=2.0, low=0.0, high=500.0, doc="time constant T")
    damping: float = scaled("1", default=0.7, typical=0.3, low=0.05, high=3.0, doc="damping ratio ζ")

    def advance(self, m: Namespace, h: Number, value: Number, memory: Values) -> tuple[Number, Values]:
        """Return the mean over the substep, and both values at its end; exact for a constant input."""
        acts, time = self.time > MIN_LAG_SHARE * h, m.maximum(self.time, MIN_LAG_SHARE * h)
        position, rate = memory[0] - value, memory[1] - memory[0]  # of the deviation, in units of the input
        damping, r, least = self.damping, h / time, 1e-6  # avoids 0/0 where ζ is 1
        square = 1.0 - damping * damping  # w is imaginary if the damping exceeds 1
        w, v = m.sqrt(m.maximum(square, least)), m.sqrt(m.maximum(-square, least))
        envelope, slow, fast = m.exp(-damping * r), m.exp((v - damping) * r), m.exp(-(v + damping) * r)
        oscillates = square > 0.0
        cosine = m.where(oscillates, envelope * m.cos(w * r), 0.5 * (slow + fast))
        sine = m.where(oscillates, envelope * m.sin(w * r) / w, 0.5 * (slow - fast) / v)
        at_end = position * cosine + (damping * position + rate) * sine
        rate_at_end = rate * cosine - (damping * rate + position) * sine
        mean = value + (rate - rate_at_end + 2.0 * damping * (position - at_end)) * time / h
        end = value + at_end
        return m.where(acts, mean, value), (m.where(acts, end, value), m.where(acts, end + rate_at_end, value))


# -- at a pair of position and velocity ------------------------------------------------------------


Coulomb = Force.named(
    "coulomb",
    equation="−F·tanh(v/ε)",
    resolved=("softness",),
    level=scaled_size("u", typical=0.1, low=0.0, high=5.0, doc="level F"),
    softness=SOFTNESS,
    force=lambda e, m, q, v: -e.level * m.tanh(v / e.softness),
)


class Stribeck(Force):
    """Dry friction with a higher level at low speed (Stribeck effect)."""

    kind = "stribeck"
    equation = "−(F + (B − F)·exp(−(v/w)²))·tanh(v/ε)"
    at_least: ClassVar[Mapping[str, str]] = {"breakaway": "level"}
    resolved = ("softness",)
    least: ClassVar[Mapping[str, float]] = {"speed": 3.0}  # a narrower peak equals the transition at 0

    level: float = scaled_size("u", typical=0.1, low=0.0, high=5.0, doc="level F at speed")
    breakaway: float = scaled_size("u", typical=0.2, low=0.0, high=10.0, doc="level B at rest")
    speed: float = scaled("v", default=0.3, typical=0.1, low=0.02, high=1.5, doc="speed w of the decay")
    softness: float = SOFTNESS

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Return −(F + (B − F)·exp(−(v/w)²))·tanh(v/ε)."""
        ratio = velocity / self.speed
        level = self.level + (self.breakaway - self.level) * m.exp(-ratio * ratio)
        return -level * m.tanh(velocity / self.softness)


Viscous = Force.named(
    "viscous",
    equation="−c·v",
    coefficient=scaled_size("u/v", typical=0.1, low=-5.0, high=5.0, doc="coefficient c"),
    force=lambda e, m, q, v: -e.coefficient * v,
)
QuadraticDrag = Force.named(
    "quadratic_drag",
    equation="−c·v·|v|",
    coefficient=scaled_size("u/v^2", typical=0.05, low=0.0, high=5.0, doc="coefficient c"),
    force=lambda e, m, q, v: -e.coefficient * v * m.sqrt(v * v),
)
CubicSpring = Force.named(
    "cubic_spring",
    equation="−k·q³",
    stiffness=scaled_size("u/q^3", typical=0.1, low=-5.0, high=5.0, doc="stiffness k"),
    force=lambda e, m, q, v: -e.stiffness * q * q * q,
)


class Cogging(Force):
    """Periodic force along the position, such as cogging; the travel in the logs covers at least two periods."""

    kind = "cogging"
    equation = "−a·sin(2π·q/P) − b·cos(2π·q/P)"
    starts = tuple({"sine": 0.05, "period": 1.0 / periods} for periods in (3.0, 6.0, 12.0))
    repeats = "period"

    sine: float = scaled_size("u", typical=0.05, low=-2.0, high=2.0, doc="amplitude a of the sine")
    cosine: float = scaled_size("u", typical=0.05, low=-2.0, high=2.0, doc="amplitude b of the cosine")
    period: float = scaled("d", default=0.25, typical=0.02, low=5e-4, high=0.5, doc="period P")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Return −a·sin(2π·q/P) − b·cos(2π·q/P)."""
        angle = 2.0 * math.pi * position / self.period
        return -self.sine * m.sin(angle) - self.cosine * m.cos(angle)


Offset = Force.named(  # for a pair of position and velocity without an input
    "offset",
    equation="+F",
    force_=scaled_size("u", typical=0.05, low=-5.0, high=5.0, doc="force F"),
    force=lambda e, m, q, v: e.force_,
)
Gap = Force.named(  # the spring transmits force only beyond the gap
    "gap",
    equation="+k·clip(q, ±w)",
    width=scaled_size("q", typical=0.1, low=0.0, high=5.0, doc="half width w"),
    stiffness=scaled("k", default=1.0, typical=0.1, low=0.5, high=2.0, doc="stiffness k of the connection"),
    force=lambda e, m, q, v: e.stiffness * m.clip(q, -e.width, e.width),
)


# -- at a storage state ----------------------------------------------------------------------------


Leak = RateTerm.named(
    "leak",
    equation="−c·s added to ds/dt",
    coefficient=scaled_size("r/q", typical=0.05, low=0.0, high=5.0, doc="coefficient c"),
    rate=lambda e, m, s: -e.coefficient * s,
)
GrowingLeak = RateTerm.named(
    "growing_leak",
    equation="−c·s·|s| added to ds/dt",
    coefficient=scaled_size("r/q^2", typical=0.05, low=0.0, high=5.0, doc="coefficient c"),
    rate=lambda e, m, s: -e.coefficient * s * m.sqrt(s * s),
)
Overflow = RateTerm.named(  # loss above a limit
    "overflow",
    equation="−c·max(s − l, 0) added to ds/dt",
    coefficient=scaled_size("r/q", typical=1.0, low=0.0, high=100.0, doc="coefficient c"),
    level=scaled("q", default=1.0, typical=0.2, low=-4.0, high=4.0, doc="level l", absolute=True),
    starts=tuple({"coefficient": 1.0, "level": level} for level in (0.3, 1.0, 1.6)),
    rate=lambda e, m, s: -e.coefficient * m.maximum(s - e.level, 0.0),
)


INPUT_TERMS = (InputBias, InputGain, DeadBand, Saturation, SquareLaw, RateLimit, Play, InputLag, SecondOrderLag)
FORCES = (Coulomb, Stribeck, Viscous, QuadraticDrag, CubicSpring, Cogging)
OF_SPRINGS, OF_CONNECTIONS = (CubicSpring, Gap), (Coulomb, QuadraticDrag)  # FMUs have the linear forces
RATE_TERMS = (Leak, GrowingLeak, Overflow)


def bound_terms(places: Sequence[Place], own: Sequence[type[Any]] = ()) -> Iterator[type[Any]]:
    """Yield every term of the catalogue and of the user, bound to each place where it can act, in order of evaluation.

    Args:
        own: Terms of the user.
    """
    for kind in (*INPUT_TERMS, *FORCES, Offset, Gap, *RATE_TERMS, *own):
        yield from (bind(kind, place) for place in places if _fits(kind, place))


def _fits(kind: type[Any], place: Place) -> bool:
    """Return True if a term can act at a place."""
    if place.opposite is not None:
        return kind in OF_CONNECTIONS or (kind in OF_SPRINGS and "k" in place.sizes)
    if kind is Viscous and place.direction is not None:
        return False  # With the relative velocity, the force would be linear again.
    if place.position >= 0 and kind is Gap:
        return False
    if place.position >= 0:
        return issubclass(kind, Force) and (kind is not Offset or not (place.is_driven or place.input >= 0))
    return issubclass(kind, RateTerm if place.state >= 0 else InputTerm)


def delay_of(inputs: Sequence[Quantity], longest: float) -> type[Delay]:
    """Return a term that delays all inputs by the same time, at most `longest` [s]."""
    memory = tuple(Quantity(q.name, q.unit, f"late {q.name}") for q in inputs)
    time = parameter(
        0.0, unit="s", bounds=(0.0, longest), neutral=0.0, typical=0.1 * longest, doc="delay T of all inputs"
    )
    return Delay.named("delay", memory=memory, longest=longest, time=time)


def sensor_errors(
    output: Quantity, size: float, step: float, duration: float, *, signed: bool = True
) -> Iterator[type[Any]]:
    """Yield the possible sensor errors of an output.

    Args:
        size: Standard deviation of the output along the logs.
        step, duration: Time between rows [s], and length of a log [s].
        signed: True if a reading is negative, which means that the sensor measures the sign.
    """
    magnitude = (Magnitude, "magnitude", "1", 0.0, 0.5, (0.0, 1.0), "share m of the magnitude")
    errors = (
        *(() if signed else (magnitude,)),
        (Bias, "bias", output.unit, 0.0, 0.02 * size, (-2.0 * size, 2.0 * size), "bias b"),
        (Scale, "scale", "1", 1.0, 0.02, (0.2, 5.0), "scale s"),
        (Drift, "drift", f"{output.unit}/s", 0.0, 0.05 * size / duration, (-size, size), "drift d"),
        (Latency, "latency", "s", 0.0, 1.0 * step, (0.0, 20.0 * step), "latency T"),
        (Lag, "lag", "s", 0.0, 3.0 * step, (0.0, 1000.0 * step), "time constant T"),
    )
    for base, kind, unit, neutral, typical, bounds, doc in errors:
        value = parameter(neutral, unit=unit, bounds=bounds, neutral=neutral, typical=typical, doc=doc)
        of = {"output": output.name, "outputs": (output.name,), "value": value}
        yield base.named(f"{kind}_at_{output.name}", **of)


# Groups of terms whose effects are similar in many logs, and an experiment that distinguishes the terms of each group.


SIMILAR_TERMS: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"delay", "lag", "second_order_lag", "rate_limit", "latency"}),
        "steps of each input in several sizes, with five times as many rows: a delay responds late, a lag at once, "
        "and a rate limit takes longer for a larger step; in a linear plant, an input and a sensor are distinguished "
        "only by a second sensor or a measurement of the input after the lag",
    ),
    (
        frozenset({"dead_band", "play", "coulomb", "stribeck"}),
        "slow ramps of each input through zero and back, and again with a reversal halfway: a dead band has no memory, "
        "play delays the response only at reversals, and friction prevents motion up to a threshold",
    ),
    (
        frozenset({"gain", "scale", "saturation", "square_law", "offset", "bias", "drift"}),
        "steps of each input in three sizes and both directions, with pauses at zero at the beginning and the end",
    ),
    (
        frozenset({"coulomb", "stribeck", "viscous", "quadratic_drag"}),
        "constant speeds in both directions, from creeping to the fastest, each followed by coasting to rest",
    ),
    (
        frozenset({"cubic_spring", "cogging", "offset"}),
        "slow motion over the whole travel, up and down, several times",
    ),
    (
        frozenset({"cubic_spring", "gap"}),
        "slow loads in both directions, from a hundredth of the largest to the largest deflection",
    ),
    (
        frozenset({"leak", "growing_leak", "overflow", "bias", "drift"}),
        "fill slowly to the top and drain to the bottom, each followed by a long pause",
    ),
)


# kind of term → kind that it equals for some parameter values (an overflow at level 0 is a leak of a level ≥ 0)
SPECIAL_CASES = {"coulomb": "stribeck", "leak": "overflow"}


def contains(rich: str, simple: str) -> bool:
    """Return True if the term `rich` equals the term `simple` at the same place for some parameter values.

    Names have the form `kind_at_place`.
    """
    (kind, _, place), (other, _, other_place) = rich.partition("_at_"), simple.partition("_at_")
    return place == other_place and SPECIAL_CASES.get(other) == kind


def experiments_for(names: Iterable[str]) -> dict[frozenset[str], str]:
    """Return group of similar terms → experiment that distinguishes them.

    Args:
        names: Names of all terms and sensor errors, `kind_at_place`.
    """
    every = [*names]
    rows = ((frozenset(n for n in every if n.partition("_at_")[0] in kinds), text) for kinds, text in SIMILAR_TERMS)
    return {row: text for row, text in rows if len(row) > 1}
