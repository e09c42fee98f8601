"""Known sources into inputs: time of action, interpolation, jumps, faults and noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.kit import Model, V, Way, u
from tests.known.table import Answer, Case, Peer, Run, at, part, runs, scenario, table

X, Y = V("x", start=0.0), V("y")
INTEGRATORS = {  # x' = u, y = x + u
    "declared": Model("integ", (u(), X, Y), {"x": "u"}, "y = x + u;", depends={"x": (), "y": ("u",)}),
    "undeclared": Model("integ", (u(), X, Y), {"x": "u"}, "y = x + u;"),
    "no feedthrough": Model("integ", (u(), X, Y), {"x": "u"}, "y = x;", depends={}),
}
DECLARED = INTEGRATORS["declared"]
PLAIN = Model("integ", (u(), X), {"x": "u"}, depends={})
TUNED = Model("tuned", (u(), X, V("k", "parameter", start=1.0, variability="tunable")), {"x": "k * u"}, depends={})
UNIT_GAIN = Model("gain", (u(), V("y")), {}, "y = u;", depends={"y": ("u",)})
WAYS: tuple[Way, ...] = ("cs", "me")
ALGORITHMS = ("gauss-seidel", "jacobi")
STEP = {"u": {"start": 0, "changes": [{"at": 1, "to": 1}]}}


def played(source: Callable[[Path], Mapping[str, Any]], **keys: Any) -> Callable[[Model, Way], Run]:
    """Return the run of a block that feeds the input u of a model."""

    def run(model: Model, way: Way) -> Run:
        return runs(lambda folder: scenario({"m": part(model, 2, way), "r": source(folder)}, ["r.u > m.u"], **keys))

    return run


def stepped(make: Callable[[str], Callable[[Model, Way], Run]], *dependences: str) -> dict[str, Run]:
    """Return the runs of kinds of feedthrough (default: all) and interfaces; by Jacobi of the declared one only."""
    return {
        f"{dependence}, {way}, {algorithm}": make(algorithm)(INTEGRATORS[dependence], way)
        for dependence in dependences or INTEGRATORS
        for way in WAYS
        for algorithm in ALGORITHMS[: 1 + (dependence == "declared")]
    }


def recorded(*rows: tuple[float, float], **keys: Any) -> Callable[[Path], dict[str, Any]]:
    return lambda folder: {"block": "playback", "file": table(folder / "u.csv", "time,u", *rows)} | keys


def fed(*rows: tuple[float, float], step: float = 0.1, header: str = "time,u") -> Callable[[Model, Way], Run]:
    """Return the run of `cosim.simulate` with an input file."""

    def run(model: Model, way: Way) -> Run:
        def simulate(folder: Path) -> Any:
            ran = cosim.simulate(model.fmu(2, way), input=table(folder / "u.csv", header, *rows), step=step)
            name = model.name
            return {f"m.{x}": ran[f"{name}.{x}"] for x in ("x", "y", "u") if f"{name}.{x}" in ran} | {"time": ran.time}

        return simulate

    return run


def moments(values: np.ndarray) -> dict[str, float]:
    """Return mean, variance and correlation of following values."""
    return {
        "mean": float(values.mean()),
        "variance": float(values.var()),
        "correlation": float(np.corrcoef(values[1:], values[:-1])[0, 1]),
    }


def column(**values: Any) -> list[Answer]:
    """Return answers of whole columns."""
    return [Answer(name.replace("_", ".", 1), None, value) for name, value in values.items()]


def step_course(duration: float = 2.0, at_: float = 1.0, height: float = 1.0) -> np.ndarray:
    """Return x of x' = u at each 0.1 s, for a step of u."""
    return height * np.maximum(0, np.round(np.arange(round(duration * 10) + 1) * 0.1, 9) - at_)


STEP_ANSWERS = [*at(1.0, m_x=0.0), *at(1.5, m_x=0.5), *at(2.0, m_x=1.0)]
STEP_SYSTEM = "x' = u, x(0) = 0; u is 0 and from 1 s on 1"
STEP_SOURCE = "x(2) = 1: a row acts from its time until the next"
RAMP = np.clip(np.arange(21) * 0.1 - 0.5, 0, 1)
GRID = np.arange(21) * 0.1
INPUT_FMPY = np.array([(0, 0), (1, 0), (1, 1), (2, 1)], dtype=[("time", float), ("u", float)])


def peer(model: Model, way: Way, rows: Any, **more: Any) -> Peer:
    signals = np.array(list(rows), dtype=[("time", float), ("u", float)])
    arguments = {"stop_time": 2.0, "output_interval": 0.1, "input": signals, "relative_tolerance": 1e-10} | more
    return Peer(lambda: model.fmu(2, way), arguments)


def _events(algorithm: str) -> Callable[[Model, Way], Run]:
    def run(model: Model, way: Way) -> Run:
        events = [{"at": 1, "set": {"m.u": 1}}]
        return runs(lambda _: scenario({"m": part(model, 2, way)}, events=events, algorithm=algorithm))

    return run


JUMP = ((0, 0), (1, 0), (1, 1), (2, 1))
CASES = [
    Case(
        "step-reference", "source", f"{STEP_SYSTEM} (`reference`).", STEP_SOURCE,
        stepped(lambda a: played(lambda _: {"block": "reference", "signals": STEP}, algorithm=a)), STEP_ANSWERS,
    ),
    Case(
        "step-playback", "source", f"{STEP_SYSTEM} (`playback` of the rows (0, 0), (1, 1)).", STEP_SOURCE,
        stepped(lambda a: played(recorded((0, 0), (1, 1)), algorithm=a), "declared"), STEP_ANSWERS,
    ),
    Case(
        "step-input-file", "source", f"{STEP_SYSTEM} (`simulate --input` of the rows (0, 0), (1, 1), (2, 1)).",
        STEP_SOURCE,
        {f"{d}, {w}": fed((0, 0), (1, 1), (2, 1))(m, w) for d, m in INTEGRATORS.items() for w in WAYS},
        column(m_x=step_course()),
        peer=peer(DECLARED, "cs", [(0, 0), (1, 1), (2, 1)]),
        differs="x(2) = 1.45: FMPy interpolates between rows, cosim holds them; each is right by its documentation. "
        "With the rows (1, 0), (1, 1) both give 1.",
    ),
    Case(
        "step-event", "source", f"{STEP_SYSTEM} (`events`).", STEP_SOURCE, stepped(_events, "declared"), STEP_ANSWERS,
    ),
    Case(
        "output-of-a-row", "source", "y = x + u with x' = u; u is 0 and from 1 s on 1.",
        "y(1) = 1: the output of a row belongs to the input of that row, also under Jacobi",
        stepped(lambda a: played(lambda _: {"block": "reference", "signals": STEP}, algorithm=a), "declared"),
        [*at(0.9, m_y=0.0), *at(1.0, m_y=1.0), *at(2.0, m_y=2.0)],
    ),
    Case(
        "ramp", "source", "x' = u; u rises from 0 at 0.5 s to 1 at 1.5 s, step 0.1 s (`reference` with `rate`).",
        "x(2) = 0.1 Σ u(t_k) = 0.95: each communication step has the value of its start",
        {way: played(lambda _: {"block": "reference", "signals": {"u": {"start": 0, "changes": [
            {"at": 0.5, "to": 1, "rate": 1}]}}})(PLAIN, way) for way in WAYS},
        [*column(m_u=RAMP), *column(m_x=np.concatenate([[0], np.cumsum(RAMP[:-1]) * 0.1]))],
    ),
    Case(
        "between-communication-points", "source", "x' = u; a recorded row at 1.05 s with step 0.1 s.",
        "x(2) = 0.9: the row acts from the first communication point at or after its time",
        {way: played(recorded((0, 0), (1.05, 1)))(PLAIN, way) for way in WAYS}
        | {"event": runs(lambda _: scenario({"m": part(PLAIN)}, events=[{"at": 1.05, "set": {"m.u": 1}}]))},
        at(2.0, m_x=0.9),
    ),
    Case(
        "linear-interpolation", "source",
        "x' = u by `playback` of (0, 0), (2, 2) with `interpolation: linear`, step 0.1 s.",
        "u(t_k) = t_k at each communication point; x(2) = ∫ t dt = 2 up to the step's half, 0.1",
        {way: played(recorded((0, 0), (2, 2), interpolation="linear"))(PLAIN, way) for way in WAYS},
        [*column(m_u=GRID), Answer("m.x", 2.0, 2.0, 0.1 + 1e-9)],
        because="an input is constant during a step: h·u(2)/2",
    ),
    Case(
        "linear-course", "source",
        "The same with `interpolate: linear` of the scenario: inputs follow lines during a step.",
        "x(2) = ∫ t dt = 2",
        {way: played(recorded((0, 0), (2, 2), interpolation="linear"), interpolate="linear")(DECLARED, way)
         for way in WAYS},
        [*at(1.0, m_x=0.5, m_y=1.5), *at(2.0, m_x=2.0, m_y=4.0)],
    ),
    Case(
        "noise", "source", "y = u with u = 0 and `noise: {variance: 4}` in 10 000 rows.",
        "mean 0, variance 4, correlation of following rows 0, each within 5 standard errors",
        {"": lambda _: moments(cosim.run(scenario(
            {"m": part(UNIT_GAIN), "r": {"block": "reference", "signals": {"u": {"start": 0}}}},
            [{"from": "r.u", "to": "m.u", "noise": {"variance": 4}}], 100, 0.01))["m.y"])},
        [Answer("mean", None, 0.0, 5 * 2 / 100), Answer("variance", None, 4.0, 5 * 4 * 2**0.5 / 100),
         Answer("correlation", None, 0.0, 5 / 100)],
        because="5 standard errors of 10 000 rows",
    ),
    Case(
        "held-row", "source", "x' = u by `simulate --input` of (0, 0), (2, 2), step 0.1 s.",
        "x(2) = 0: a row holds until the next", {way: fed((0, 0), (2, 2))(PLAIN, way) for way in WAYS},
        [Answer("m.x", None, np.zeros(21))],
        peer=peer(PLAIN, "me", [(0, 0), (2, 2)]),
        differs="x(2) = 1.86 (model exchange), 1.9 (co-simulation): FMPy interpolates; ∫ t dt = 2. "
        "cosim does so with `interpolation: linear`.",
    ),
    Case(
        "equal-times", "source", "x' = u by an input file with the rows (0, 0), (1, 0), (1, 1), (2, 1).",
        "u(1) = 1, x(2) = 1: equal times are a jump, and the last row is the value after it",
        {f"{way}, file": fed(*JUMP)(PLAIN, way) for way in WAYS}
        | {f"{way}, playback": played(recorded(*JUMP))(PLAIN, way) for way in WAYS},
        [*column(m_u=(GRID > 0.95).astype(float)), *column(m_x=step_course())],
        peer=peer(PLAIN, "cs", JUMP),
    ),
    Case(
        "epoch-rows", "source", "u_k = k by rows 0.1 s apart from 1 700 000 000 s on, step 0.1 s (`playback`).",
        "u = k in row k: times are equal within the spacing of doubles, 2.4e-7 s",
        {way: runs(lambda folder, way=way: scenario({
            "m": part(DECLARED, 2, way),
            "r": {"block": "playback", "file": table(folder / "u.csv", "time,u", *(
                (f"{1700000000 + k / 10:.1f}", k) for k in range(31)))}},
            ["r.u > m.u"], 3, start_time=1700000000)) for way in WAYS},
        [*column(r_u=np.arange(31.0)), *column(m_u=np.arange(31.0)),
         Answer("m.x", None, np.concatenate([[0], np.cumsum(np.arange(30)) * 0.1]), 1.1e-4)],
        because="x: each step is as long as two rounded times are apart, 0.1 s ± 2.4e-7 s; Σ k · 2.4e-7",
    ),
    Case(
        "epoch-changes", "source", "u is 1 from 1 700 000 000.2 s on, step 0.1 s (`reference`; `events`).",
        "u = 0, 0, 1, 1, …",
        {
            "reference": runs(lambda _: scenario({"m": part(PLAIN), "r": {"block": "reference", "signals": {
                "u": {"start": 0, "changes": [{"at": 1700000000.2, "to": 1}]}}}}, ["r.u > m.u"], 1,
                start_time=1700000000)),
            "events": runs(lambda _: scenario({"m": part(PLAIN)}, (), 1, start_time=1700000000,
                                              events=[{"at": 1700000000.2, "set": {"m.u": 1}}])),
        },
        column(m_u=(np.arange(11) >= 2).astype(float)),
    ),
    Case(
        "bias-fault", "source", "x' = u with u = 0 and a `bias` fault of 0.5 from 0.5 s to 1 s.",
        "x(2) = 0.5 · 6 · 0.1 = 0.3: both ends are included (scenario.md), six communication points",
        {way: runs(lambda _, way=way: scenario(
            {"m": part(PLAIN, 2, way), "r": {"block": "reference", "signals": {"u": {"start": 0}}}}, ["r.u > m.u"],
            faults=[{"on": "m.u", "kind": "bias", "from": 0.5, "to": 1, "value": 0.5}])) for way in WAYS},
        at(2.0, m_x=0.3),
    ),
    Case(
        "delay-fault", "source", "x' = u; u is 1 from 0.5 s on, delayed by 0.3 s on its connection.",
        "x(2) = 2 − 0.8 = 1.2",
        {way: runs(lambda _, way=way: scenario(
            {"m": part(PLAIN, 2, way), "r": {"block": "reference", "signals": {"u": {"start": 0, "changes": [
                {"at": 0.5, "to": 1}]}}}}, ["r.u > m.u"], faults=[{"on": "m.u", "kind": "delay", "delay": 0.3}]))
         for way in WAYS},
        at(2.0, m_x=1.2),
    ),
    Case(
        "biased-connection", "source", "x' = u; u = 1 through a connection with `noise: {variance: 0, bias: 0.25}`.",
        "x(2) = 1.25 · 2 = 2.5",
        {way: runs(lambda _, way=way: scenario(
            {"m": part(PLAIN, 2, way), "r": {"block": "reference", "signals": {"u": {"start": 1}}}},
            [{"from": "r.u", "to": "m.u", "noise": {"variance": 0, "bias": 0.25}}])) for way in WAYS},
        at(2.0, m_x=2.5),
    ),
    Case(
        "event-in-the-middle", "source", "x' = k u with tunable k: u = 1, k is 1 and from 0.5 s on 3 (`events`).",
        "x(2) = 0.5 + 3 · 1.5 = 5",
        {way: runs(lambda _, way=way: scenario({"m": part(TUNED, 2, way, start={"u": 1})},
                                               events=[{"at": "500 ms", "set": {"m.k": 3}}])) for way in WAYS},
        at(2.0, m_x=5.0),
    ),
]  # fmt: skip
