"""Known sources into inputs: time of action, interpolation, jumps, faults and noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.kit import Model
from tests.known.table import ALGORITHMS, WAYS, Case, Run, at, found, jump, part, recorded, reference, run, simulated

DIRECT = {"y": ("u",)}
DECLARED, UNDECLARED = (Model("input u = 0, x = 0, y", "x' = u", "y = x + u;", depends) for depends in (DIRECT, None))
INTEGRATORS = {  # x' = u, y = x + u
    "declared": DECLARED,
    "undeclared": UNDECLARED,
    "no feedthrough": Model("input u = 0, x = 0, y", "x' = u", "y = x;"),
}
PLAIN = Model("input u = 0, x = 0", "x' = u")
UNIT_GAIN = Model("input u = 0, y", "", "y = u;", DIRECT)
GRID = np.arange(21) * 0.1
STEP = at(1.0, m_x=0.0) + at(1.5, m_x=0.5) + at(2.0, m_x=1.0)
STEP_SYSTEM = "x' = u, x(0) = 0; u is 0 and from 1 s on 1"
STEP_SOURCE = "x(2) = 1: a row acts from its time until the next"
RAMP = np.clip(GRID - 0.5, 0, 1)
EPOCH = 1700000000
LINE = recorded("time,u", (0, 0), (2, 2), interpolation="linear")


def stepped(door: str, *dependences: str) -> dict[str, Run]:
    """Return the runs of kinds of feedthrough and interfaces; by Jacobi of the declared one only."""
    return {
        f"{dependence}, {way}, {algorithm}": jump(part(INTEGRATORS[dependence], 2, way), door, algorithm=algorithm)
        for dependence in dependences
        for way in WAYS
        for algorithm in ALGORITHMS[: 1 + (dependence == "declared")]
    }


def fed(source: Any, wire: Any = "r.u > m.u", model: Model = PLAIN, **keys: Any) -> dict[str, Run]:
    """Return the runs of a model that a block feeds, by both interfaces."""
    return {way: run({"m": part(model, 2, way), "r": source}, wire, **keys) for way in WAYS}


def noise_of(content: Any, _: Path) -> dict[str, float]:
    """Return mean, variance and correlation of following values of m.y."""
    values = cosim.run(content)["m.y"]
    correlation = np.corrcoef(values[1:], values[:-1])[0, 1]
    return {"mean": values.mean(), "variance": values.var(), "correlation": correlation}


JUMP = recorded("time,u", (0, 0), (1, 0), (1, 1), (2, 1))
CASES = [
    Case(
        "step-reference", f"{STEP_SYSTEM} (`reference`).", STEP_SOURCE, stepped("reference", *INTEGRATORS), STEP,
    ),
    Case(
        "step-playback", f"{STEP_SYSTEM} (`playback` of the rows (0, 0), (1, 1)).", STEP_SOURCE,
        stepped("playback", "declared"), STEP,
    ),
    Case(
        "step-input-file", f"{STEP_SYSTEM} (`simulate --input` of the rows (0, 0), (1, 1), (2, 1)).", STEP_SOURCE,
        {f"{name}, {way}": r for name, model in INTEGRATORS.items() for way, r in reversed(fed(
            recorded("time,u", (0, 0), (1, 1), (2, 1)), model=model, door=simulated).items())},
        at(None, m_x=np.maximum(0, GRID - 1)),
        "x(2) = 1.45: FMPy interpolates between rows, cosim holds them; each is right by its documentation. "
        "With the rows (1, 0), (1, 1) both give 1.",
    ),
    Case("step-event", f"{STEP_SYSTEM} (`events`).", STEP_SOURCE, stepped("event", "declared"), STEP),
    Case(
        "output-of-a-row", "y = x + u with x' = u; u is 0 and from 1 s on 1.",
        "y(1) = 1: the output of a row belongs to the input of that row, also under Jacobi",
        stepped("reference", "declared"), at(0.9, m_y=0.0) + at(1.0, m_y=1.0) + at(2.0, m_y=2.0),
    ),
    Case(
        "ramp", "x' = u; u rises from 0 at 0.5 s to 1 at 1.5 s, step 0.1 s (`reference` with `rate`).",
        "x(2) = 0.1 Σ u(t_k) = 0.95: each communication step has the value of its start",
        fed(reference(0, {"at": 0.5, "to": 1, "rate": 1})),
        at(None, m_u=RAMP, m_x=np.cumsum([0, *RAMP[:-1]]) * 0.1),
    ),
    Case(
        "between-communication-points", "x' = u; a recorded row at 1.05 s with step 0.1 s.",
        "x(2) = 0.9: the row acts from the first communication point at or after its time",
        {f"{way}, {door}": jump(part(PLAIN, 2, way), door, 1.05) for way in WAYS for door in ("playback", "event")},
        at(2.0, m_x=0.9),
    ),
    Case(
        "linear-interpolation", "x' = u by `playback` of (0, 0), (2, 2) with `interpolation: linear`, step 0.1 s.",
        "u(t_k) = t_k at each communication point; x(2) = ∫ t dt = 2 up to the step's half, 0.1", fed(LINE),
        at(None, m_u=GRID) + at(2.0, 0.1 + 1e-9, m_x=2.0),  # an input is constant during a step: h·u(2)/2
    ),
    Case(
        "linear-course", "The same with `interpolate: linear` of the scenario: inputs follow lines during a step.",
        "x(2) = ∫ t dt = 2", fed(LINE, model=DECLARED, interpolate="linear"),
        at(1.0, m_x=0.5, m_y=1.5) + at(2.0, m_x=2.0, m_y=4.0),
    ),
    Case(
        "noise", "y = u with u = 0 and `noise: {variance: 4}` in 10 000 rows.",
        "mean 0, variance 4, correlation of following rows 0, each within 5 standard errors",
        run({"m": part(UNIT_GAIN), "r": reference(0)}, {"r.u > m.u": {"noise": {"variance": 4}}}, 100, 0.01, noise_of),
        found({"mean": 0.0}, 5 * 2 / 100) + found({"variance": 4.0}, 5 * 4 * 2**0.5 / 100)
        + found({"correlation": 0.0}, 5 / 100),
    ),
    Case(
        "equal-times", "x' = u by an input file with the rows (0, 0), (1, 0), (1, 1), (2, 1).",
        "u(1) = 1, x(2) = 1: equal times are a jump, and the last row is the value after it",
        fed(JUMP) | {f"{way}, file": r for way, r in fed(JUMP, door=simulated).items()},
        at(None, m_u=(GRID > 0.95).astype(float), m_x=np.maximum(0, GRID - 1)), "same",
    ),
    Case(
        "epoch-rows", "u_k = k by rows 0.1 s apart from 1 700 000 000 s on, step 0.1 s (`playback`).",
        "u = k in row k: times are equal within the spacing of doubles, 2.4e-7 s",
        fed(recorded("time,u", *((f"{EPOCH + k / 10:.1f}", k) for k in range(31))), model=DECLARED, duration=3,
            start_time=EPOCH),
        at(None, r_u=np.arange(31.0), m_u=np.arange(31.0))
        # each step is as long as two rounded times are apart, 0.1 s ± 2.4e-7 s; Σ k · 2.4e-7
        + at(None, 1.1e-4, m_x=np.cumsum([0, *range(30)]) * 0.1),
    ),
    Case(
        "epoch-changes", "u is 1 from 1 700 000 000.2 s on, step 0.1 s (`reference`; `events`; `faults`).",
        "u = 0, 0, 1, 1, …",
        {door: jump(part(PLAIN), door, EPOCH + 0.2, start_time=EPOCH) for door in ("reference", "event")}
        | fed(reference(0), faults=[{"on": "m.u", "kind": "bias", "from": EPOCH + 0.2, "value": 1}], start_time=EPOCH),
        at(None, m_u=(np.arange(21) >= 2).astype(float)),
    ),
    Case(
        "bias-fault", "x' = u with u = 0 and a `bias` fault of 0.5 from 0.5 s to 1 s.",
        "x(2) = 0.5 · 6 · 0.1 = 0.3: both ends are included (scenario.md), six communication points",
        fed(reference(0), faults=[{"on": "m.u", "kind": "bias", "from": 0.5, "to": 1, "value": 0.5}]), at(2.0, m_x=0.3),
    ),
    Case(
        "delay-fault", "x' = u; u is 1 from 0.5 s on, delayed by 0.3 s on its connection.", "x(2) = 2 − 0.8 = 1.2",
        fed(reference(0, {"at": 0.5, "to": 1}), faults=[{"on": "m.u", "kind": "delay", "delay": 0.3}]),
        at(2.0, m_x=1.2),
    ),
    Case(
        "biased-connection", "x' = u; u = 1 through a connection with `noise: {variance: 0, bias: 0.25}`.",
        "x(2) = 1.25 · 2 = 2.5", fed(reference(1), {"r.u > m.u": {"noise": {"variance": 0, "bias": 0.25}}}),
        at(2.0, m_x=2.5),
    ),
]  # fmt: skip
