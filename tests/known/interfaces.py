"""Interfaces of FMI 1.0, 2.0 and 3.0: start values, parameters, aliases; events; start times."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from cosim.core.errors import SimulationError
from tests.instants import CONSTANT, instants_fmu
from tests.known.kit import Model, V, Way, p, u
from tests.known.sources import PLAIN
from tests.known.table import Answer, Case, Peer, at, part, runs, scenario, table

WAYS: tuple[Way, ...] = ("cs", "me")


ALL: tuple[tuple[int, Way], ...] = tuple((version, way) for version in (1, 2, 3) for way in WAYS)
THREE: tuple[tuple[int, Way], ...] = ((1, "me"), (2, "cs"), (3, "me"))
OTHERS: tuple[tuple[int, Way], ...] = ((1, "cs"), (2, "me"), (3, "cs"))
TWO: tuple[tuple[int, Way], ...] = ((2, "me"), (3, "cs"))
EXCHANGE: tuple[tuple[int, Way], ...] = ((1, "me"), (2, "me"), (3, "me"))


def everywhere(
    model: Model, duration: float = 1, step: float = 0.1, *, kinds: tuple[tuple[int, Way], ...] = THREE,
    solver: str = "", tolerance: float = 1e-10, start: Any = None, **keys: Any,
) -> dict[str, Callable[[Path], Any]]:  # fmt: skip
    """Return the runs of a model by several interfaces."""
    more = ({"solver": solver} if solver else {}) | ({"start": start} if start else {})
    return {
        f"FMI {version} {way}{' ' if solver else ''}{solver}": runs(
            lambda _, version=version, way=way: scenario(
                {"m": part(model, version, way, **more)}, (), duration, step, tolerance=tolerance, **keys
            )
        )
        for version, way in kinds
    }


def peer(model: Model, end: float, way: Way = "me", step: float = 0.1, version: int = 2, **more: Any) -> Peer:
    arguments = {"stop_time": end, "output_interval": step, "relative_tolerance": 1e-10, "record_events": False} | more
    return Peer(lambda: model.fmu(version, way), arguments)


DECAY = Model("decay", (V("x", start=1.0), p("k", 1.0)), {"x": "-k * x"}, depends={})
TUNABLE = Model("tunable", (V("x", start=1.0), p("k", 1.0, variability="tunable")), {"x": "-k * x"}, depends={})
INTEGRAL = Model("integral", (u(), V("z", start=0.0)), {"z": "u"}, depends={})
OWN, OTHER = (
    Model(
        "own",
        (u(), V("y")),
        {},
        "y = y1(u);",
        depends={"y": ("u",)},
        functions=f"double y1(double x) {{ return {gain} * x; }}",
    )
    for gain in (2, 3)
)
DERIVED = Model(
    "derived",
    (V("x", start=0.0), p("a", 2.0), p("b", 3.0), V("area", "calculatedParameter"), V("y")),
    {"x": "-x"},
    "area = a * b; if (initializing) x = area; y = x / area;",
    "x = area;",
    depends={},
)
INITIAL = Model(
    "initial",
    (u(), V("x", "local"), V("y")),
    {"x": "-x"},
    "if (initializing) x = 2 * u; y = x;",
    "x = 2 * u;",
    depends={},
    initial={"y": ("u",)},
)
ALIASED = Model("aliased", (V("x", start=1.0), V("same", alias="x"), p("k", 1.0)), {"x": "-k * x"}, depends={})
NEGATED = Model(
    "negated", (u(), V("flow_out", start=6.0), V("flow_in", alias="-flow_out")), {"flow_out": "u"}, depends={}
)
NEGATED_INPUT = Model("negated", (u(), u("back", None, alias="-u"), V("x", start=0.0)), {"x": "u"}, depends={})
TWO_NAMES = Model(
    "two_names", (u(), u("same", None, alias="u"), u("n", 0, type="Int32"), u("nn", None, type="Int32", alias="n"),
        V("x", start=0.0)), {"x": "u + n"}, depends={}
)  # fmt: skip
OPPOSITE = Model(
    "opposite", (u(), u("same", None, alias="-u"), u("n", 0, type="Int32"), u("nn", None, type="Int32", alias="-n"),
        V("x", start=0.0)), {"x": "u + n"}, depends={}
)  # fmt: skip


def two_names(way: str, version: int, kind: Way) -> Callable[[Path], Any]:
    """Return a run that brings 2 and 3 into the second names of two inputs."""

    def content(folder: Path) -> Any:
        m, values = part(OPPOSITE if version == 1 else TWO_NAMES, version, kind), {"same": 2.0, "nn": 3}
        if way == "start":
            return scenario({"m": m | {"start": values}}, (), 1)
        if way == "event":
            return scenario({"m": m}, (), 1, events=[{"at": 0, "set": {f"m.{n}": v for n, v in values.items()}}])
        played = {"block": "playback", "file": table(folder / "u.csv", "time,same,nn", (0, 1, 3), (1, 1, 3))}
        faults = [{"on": "m.same", "kind": "bias", "value": 1.0}]
        return scenario({"r": played, "m": m}, ["r.same > m.same", "r.nn > m.nn"], 1, faults=faults)

    return runs(content)


TIMED = Model("timed", (V("x", start=0.0), V("now")), {"x": "time"}, "now = time;", depends={})
ACCUMULATED = Model(
    "steps",
    (V("n", type="Int32", start=0), V("gap", start=0.0), V("now", start=0.0)),
    {},
    step="if (n && fabs(t - memory[0]) > gap) gap = fabs(t - memory[0]); memory[0] = t + h; n += 1; now = t + h;",
    depends={},
)

INTERFACE = [
    Case(
        "decay", "interface", "x' = −x, x(0) = 1.", "x(t) = e^−t", everywhere(DECAY, kinds=ALL),
        [Answer("m.x", None, np.exp(-np.arange(11) * 0.1), 2e-9)],
        because="CVODE at 1e-10 a step", peer=peer(DECAY, 1),
    ),
    Case(
        "declared-without-feedthrough", "interface",
        "x' = −x feeds z' = u, whose FMU declares that z does not depend directly on u; h = 0.1 s, Gauss-Seidel.",
        "z(1) = 0.1 Σ e^−t_k: each step has the input of its start (coupling.md), in FMI 1.0 too (DirectDependency)",
        {f"FMI {v} {w}": runs(lambda _, v=v, w=w: scenario(
            {"z": part(INTEGRAL, v, w), "x": part(DECAY, 2)}, ["x.x > z.u"], 1, tolerance=1e-10))
         for v, w in ((1, "cs"), (1, "me"), (2, "cs"), (3, "me"))},
        at(1.0, 1e-8, z_z=0.1 * np.exp(-np.arange(10) * 0.1).sum()), because="CVODE at 1e-10 a step",
    ),
    Case(
        "default-tolerance", "interface", "The same by model exchange with default settings.", "e^−1 within 1e-4",
        {"": lambda _: cosim.simulate(DECAY.fmu(2, "me"), stop=1, step=0.1)},
        [Answer("decay.x", 1.0, math.exp(-1), 1e-4)],
        because="CVODE at 1e-5, some ten steps", peer=peer(DECAY, 1, relative_tolerance=None),
    ),
    Case(
        "parameter", "interface", "x' = −k x with k = 2 in `start`.", "x(1) = e^−2", everywhere(DECAY, start={"k": 2}),
        at(1.0, 2e-9, m_x=math.exp(-2)), because="CVODE at 1e-10 a step", peer=peer(DECAY, 1, start_values={"k": 2.0}),
    ),
    Case(
        "start-of-a-state", "interface", "x' = −x with x = 3 in `start`.", "x(0) = 3, x(1) = 3 e^−1",
        everywhere(DECAY, start={"x": 3}, kinds=OTHERS), [*at(0.0, m_x=3.0), *at(1.0, 1e-8, m_x=3 * math.exp(-1))],
        because="CVODE at 1e-10 a step", peer=peer(DECAY, 1, start_values={"x": 3.0}),
    ),
    Case(
        "tunable", "interface", "x' = −k x; the tunable k is 1 and from 0.5 s on 2.", "x(1) = e^−1.5",
        everywhere(TUNABLE, kinds=TWO, events=[{"at": 0.5, "set": {"m.k": 2}}]),
        at(1.0, 2e-9, m_x=math.exp(-1.5)), because="CVODE at 1e-10 a step",
    ),
    Case(
        "calculated-parameter", "interface", "x(0) = a b, computed by the FMU; a = 2, b = 5 in `start`; x' = −x.",
        "x(0) = area = 10, x(1) = 10 e^−1: calculated values follow parameters in initialization",
        everywhere(DERIVED, kinds=TWO, start={"b": 5}, record=["m.*"]),
        [*at(0.0, m_x=10.0, m_area=10.0), *at(1.0, 2e-8, m_x=10 * math.exp(-1), m_y=math.exp(-1))],
        because="CVODE at 1e-10 a step, relative to 10", peer=peer(DERIVED, 1, start_values={"b": 5.0}),
    ),
    Case(
        "initial-unknowns", "interface",
        "Three FMUs with y(0) = 2 u(0) and y' = −y in a row, written from the last; u = 3.",
        "24 e^−t: initial values pass through the whole row before time begins",
        {f"FMI {v} {w}": runs(lambda _, v=v, w=w: scenario(
            {"c": part(INITIAL, v, w), "b": part(INITIAL, v, w), "a": part(INITIAL, v, w, start={"u": 3})},
            ["b.y > c.u", "a.y > b.u"], 0.3, tolerance=1e-10)) for v, w in TWO},
        [*at(0.0, a_y=6.0, b_y=12.0, c_y=24.0), *at(0.3, 1e-7, c_y=24 * math.exp(-0.3))],
        because="CVODE at 1e-10 a step, relative to 24",
    ),
    Case(
        "recorded-derivative", "interface", "x' = −2 x with `record: [m.*]`.", "der(x)(0) = −2, der(x)(1) = −2 e^−2",
        everywhere(DECAY, start={"k": 2}, record=["m.*"]),
        [Answer("m.der(x)", 0.0, -2.0), Answer("m.der(x)", 1.0, -2 * math.exp(-2), 1e-8), *at(0.0, m_k=2.0)],
        because="CVODE at 1e-10 a step",
    ),
    Case(
        "alias", "interface", "Two names of one variable of x' = −x.", "both are e^−t",
        everywhere(ALIASED, kinds=OTHERS),
        at(1.0, 2e-9, m_x=math.exp(-1), m_same=math.exp(-1)), because="CVODE at 1e-10 a step", peer=peer(ALIASED, 1),
    ),
    Case(
        "negated-alias", "interface", "`flow_in` is the negated alias of `flow_out` = 6 + t.",
        "flow_in = −6 − t (FMI 1.0, alias)", everywhere(NEGATED, kinds=((1, "cs"), (1, "me")), start={"u": 1}),
        [*at(0.0, m_flow_out=6.0, m_flow_in=-6.0), *at(1.0, 1e-8, m_flow_in=-7.0)],
        because="CVODE at 1e-10 a step, relative to 7", peer=peer(NEGATED, 1, version=1, start_values={"u": 1.0}),
        differs="flow_in(1) = 7: FMPy does not read the attribute. The standard is right: the value is negated.",
    ),
    Case(
        "negated-alias-connected", "interface", "The negated alias −6 − t as input u of x' = u, step 0.1 s.",
        "x(1) = −Σ 0.1 (6 + t_k) = −6.45", {"": runs(lambda _: scenario(
            {"n": part(NEGATED, 1, start={"u": 1}), "m": part(PLAIN)}, ["n.flow_in > m.u"], 1))},
        at(1.0, m_x=-6.45),
    ),
    *(
        Case(
            f"{'negated' if sign < 0 else 'same'}-input", "interface",
            f"A Real of 2 and an Int32 of 3 into {'negated aliases' if sign < 0 else 'second names'} of the inputs u "
            "and n of x' = u + n; the Real comes as 1 with a bias of 1 where it is connected.",
            f"u = {2 * sign}, n = {3 * sign}, x(1) = {5 * sign}: both names have the value of one variable",
            {f"FMI {v} {w}, {way}": two_names(way, v, w) for v in versions for w in WAYS
             for way in ("start", "event", "connection")},
            at(1.0, 1e-8, m_u=2.0 * sign, m_n=3 * sign, m_same=2.0, m_nn=3, m_x=5.0 * sign),
            because="CVODE at 1e-5 of a constant slope",
        )
        for sign, versions in ((-1, (1,)), (1, (2,)))
    ),
    Case(
        "open-input", "interface", "x' = u with u = 0.5 in `start` and no source.", "x(1) = 0.5",
        everywhere(PLAIN, start={"u": 0.5}, kinds=OTHERS), at(1.0, m_x=0.5),
        peer=peer(PLAIN, 1, start_values={"u": 0.5}),
    ),
    Case(
        "own-process", "interface", "x' = −x in a process of its own.", "x(1) = e^−1",
        {"": runs(lambda _: scenario({"m": part(DECAY, 3, "me", process="own")}, (), 1, tolerance=1e-10))},
        at(1.0, 2e-9, m_x=math.exp(-1)), because="CVODE at 1e-10 a step",
    ),
    Case(
        "own-function", "interface",
        "y = y1(u) with a function y1(u) = 2 u of the FMU, not static, which libm has too; u = 1.",
        "2: an FMU calls its own functions, not the Bessel function of libm",
        {"": runs(lambda _: scenario({"m": part(OWN, start={"u": 1})}, (), 0.2))}, at(0.2, m_y=2.0),
        peer=peer(OWN, 0.2, "cs", start_values={"u": 1.0}),
        differs="−0.781213, which is Y₁(1): its Python has loaded libm first. The FMU is right.",
    ),
    Case(
        "equal-names", "interface", "Two FMUs of one name, whose functions of one name have the gains 2 and 3; u = 1.",
        "2 and 3",
        {"": runs(lambda _: scenario({"a": part(OWN, start={"u": 1}), "b": part(OTHER, start={"u": 1})}, (), 0.2))},
        at(0.2, a_y=2.0, b_y=3.0),
    ),
    Case(
        "mixed-versions", "interface", "x' = −x of FMI 1.0 feeds z' = u of FMI 2.0 and of FMI 3.0, h = 0.1 s.",
        "z(1) = 0.1 Σ e^−t_k", {way: runs(lambda _, way=way: scenario(
            {"b": part(PLAIN, 2, way), "c": part(PLAIN, 3, way), "a": part(DECAY, 1, way)}, ["a.x > b.u", "a.x > c.u"],
            1,
            tolerance=1e-10)) for way in WAYS},
        at(1.0, 1e-8, b_x=0.1 * np.exp(-np.arange(10) * 0.1).sum(), c_x=0.1 * np.exp(-np.arange(10) * 0.1).sum()),
        because="CVODE at 1e-10 a step",
    ),
]  # fmt: skip

# -- events ---------------------------------------------------------------------------------------------

G, E = 9.81, 0.7
FALL = math.sqrt(2 / G)  # from 1 m
BALL = Model(
    "ball",
    (
        V("h", start=1.0),
        V("v", start=0.0),
        p("e", E),
        V("n", type="Int32", start=0),
        V("when", start=0.0, variability="discrete"),
    ),
    {"h": "v", "v": "-9.81"},
    zeros=("h",),
    event="if (h <= 1e-10 && v < 0) { v = -e * v; h = 0; n += 1; when = time; changed = true; }",
    depends={},
)
ALARM = Model(
    "alarm",
    (V("x", start=0.0), V("k", start=1.0, variability="discrete"), V("n", type="Int32", start=0)),
    {"x": "k"},
    event="if (n == 0) next = 0.35; if (time >= next) { k = 2; n += 1; next = n == 1 ? 0.35 + 1e-9 : INFINITY; }",
    depends={},
)
TRIANGLE = Model(
    "triangle",
    (V("x", start=0.0), V("s", start=1.0, variability="discrete")),
    {"x": "s"},
    zeros=("x - 1", "x + 1"),
    event="if (x >= 1 - 1e-9 && s > 0) s = -1; else if (x <= -1 + 1e-9 && s < 0) s = 1;",
    depends={},
)
ITERATED = Model(
    "iterated",
    (V("n", type="Int32", start=0), V("x", start=0.0)),
    {"x": "n"},
    event="if (memory[0] == 0) { memory[0] = 1; next = 0.5; } else if (time >= 0.5 && n < 3) { n += 1; more = n < 3; "
    "next = INFINITY; changed = false; }",
    depends={},
)
ASKING = Model(
    "asking",
    (V("x", start=0.0), V("k", start=1.0, variability="discrete")),
    {"x": "k"},
    event="if (time >= 0.5) k = -1;",
    completed="ask = time >= 0.5 && k > 0;",
    depends={},
)
ENDING = Model(
    "ending",
    (V("x", start=0.0),),
    {"x": "1"},
    step="end = time >= 0.5 - 1e-9;",
    event="next = 0.5; end = time >= 0.5;",
    depends={},
)
HOLD = Model(
    "hold",
    (u(), V("x", start=0.0), V("y", start=0.0, variability="discrete")),
    {"x": "y"},
    start="next = 0.25;",
    event="if (!initializing && time >= next - 1e-12) { y = u; next += 0.25; }",
)
HIT = Model(
    "hit",
    (u(start=1.0), V("x", start=0.0), V("y", start=0.0, variability="discrete")),
    {"x": "1"},
    zeros=("x - 0.5",),
    event="if (x >= 0.5 - 1e-9 && y == 0) y = u;",
)
DELAY = Model(  # the last 100 completed steps; y is x of 0.1 s before
    "delay",
    (V("x", start=0.0), V("y"), V("calls", type="Int32", start=0)),
    {"x": "cos(time)"},
    "{ int last = calls % 100; double t0 = time - 0.1; y = 0;"
    " double ta = time, xa = x;"
    " for (int k = 0; k < 100 && k < calls; k++) { int i = (calls - 1 - k) % 100;"
    " double tb = memory[i], xb = memory[100 + i];"
    " if (tb <= t0) { y = ta > tb ? xb + (xa - xb) * (t0 - tb) / (ta - tb) : xb; break; } ta = tb; xa = xb; } }",
    completed="{ int i = calls % 100; memory[i] = time; memory[100 + i] = x; calls += 1; }",
    depends={},
)


def bounce(n: int) -> float:
    """Return the time of a bounce, from 1."""
    return FALL * (1 + 2 * sum(E**k for k in range(1, n)))


def height(t: float) -> float:
    """Return the height at a time."""
    n = sum(bounce(k) <= t for k in range(1, 30))
    if n == 0:
        return 1 - G * t * t / 2
    speed, since = G * FALL * E**n, t - bounce(n)
    return speed * since - G * since * since / 2


def both_solvers(model: Model, duration: float, step: float) -> dict[str, Any]:
    return {
        name: run
        for solver, kinds in (("cvode", EXCHANGE), ("solve_ivp", EXCHANGE[1:2]))
        for name, run in everywhere(model, duration, step, kinds=kinds, solver=solver).items()
    }


def instants(duration: float = 1, step: float = 0.1, sample: str | None = None, **more: Any) -> Callable[[Path], Any]:
    """Return the run of `instants.c`, an FMU of FMI 3.0 with event mode: x rises by u up to `level`."""
    start, keys = more.pop("start", {}), more.pop("keys", {})

    def run(folder: Path) -> Any:
        fmu = instants_fmu(folder / "i.fmu", sample, updates=sample is None, **more)
        component = {"fmu": str(fmu), "event_mode": True, "start": start, **keys}
        return cosim.run(scenario({"m": component}, (), duration, step))

    return run


def stopped(run: Callable[[Path], Any], *signals: str) -> Callable[[Path], Any]:
    """Return exit code, last time and largest negative values of a run that may end with an error."""

    def ended(folder: Path) -> dict[str, Any]:
        code = 0
        try:
            run(folder)
        except SimulationError as error:
            code = error.exit_code
        ran = cosim.read(folder / "out")
        return {"exit code": code, "end": float(ran.time[-1])} | {
            f"below {s}": float(min(0, np.min(ran[s]))) for s in signals
        }

    return ended


def jumping(model: Model, before: float, after: float, version: int, step: float, door: str) -> Callable[[Path], Any]:
    """Return the run of model exchange whose input jumps at 0.5 s."""

    def content(folder: Path) -> dict[str, Any]:
        component = part(model, version, "me", start={"u": before})
        if door == "event":
            return scenario({"m": component}, (), 1, step, events=[{"at": 0.5, "set": {"m.u": after}}])
        rows = {"file": table(folder / "u.csv", "time,u", (0, before), (0.5, after))}
        signals = {"signals": {"u": {"start": before, "changes": [{"at": 0.5, "to": after}]}}}
        source = {"block": "playback"} | rows if door == "playback" else {"block": "reference"} | signals
        keys = {"algorithm": "jacobi"} if door == "jacobi" else {}
        return scenario({"r": source, "m": component}, ["r.u > m.u"], 1, step, **keys)

    return runs(content)


def all_jumping(model: Model, before: float, after: float) -> dict[str, Any]:
    return {
        f"FMI {version}, step {step} s, {door}": jumping(model, before, after, version, step, door)
        for version in (1, 2, 3)
        for step, door in ((0.25, "playback"), (0.05, "reference"), (0.05, "event"), (0.25, "jacobi"))
    }


TICKS = np.floor(np.arange(11) + 1.0)
EVENTS = [
    Case(
        "first-bounces", "event", "A ball of e = 0.7 falls from 1 m.",
        "bounces at √(2/g)(1 + 2 Σ eⁱ): 0.4515, 1.0836, 1.5261 s",
        both_solvers(BALL, 1.6, 0.1),
        [*at(0.5, 1e-6, m_when=bounce(1), m_h=height(0.5)), *at(1.1, 1e-6, m_when=bounce(2)),
         *at(1.6, 1e-6, m_when=bounce(3), m_h=height(1.6)), *at(1.6, 0, m_n=3)],
        because="solvers at 1e-10 a step, and errors of bounces add up", peer=peer(BALL, 1.6),
    ),
    Case(
        "time-events", "event", "x' = 1, from the time event at 0.35 s on 2; another time event 1e-9 s later.",
        "x(1) = 0.35 + 2 · 0.65 = 1.65, two events", everywhere(ALARM, kinds=EXCHANGE),
        [*at(1.0, 1e-8, m_x=1.65), *at(1.0, 0, m_n=2)], because="CVODE at 1e-10 a step", peer=peer(ALARM, 1),
    ),
    Case(
        "sampled-at-a-jump", "event", "x' = y; y becomes u at time events each 0.25 s; u jumps from 0 to 1 at 0.5 s.",
        "y(0.5) = 1, x(1) = 0.5: of one time, inputs are set before discrete states are updated (FMI 3.0, 3.2)",
        all_jumping(HOLD, 0.0, 1.0), [*at(0.25, 0, m_y=0.0), *at(0.5, 0, m_y=1.0), *at(1.0, 1e-8, m_x=0.5)],
        because="CVODE at 1e-10 a step",
    ),
    Case(
        "state-event-at-a-jump", "event", "x' = 1; y becomes u at x = 0.5; u jumps from 1 to 2 at 0.5 s.",
        "y(1) = 2, as above", all_jumping(HIT, 1.0, 2.0), at(1.0, 0, m_y=2.0),
    ),
    Case(
        "event-on-a-communication-point", "event",
        "x' = s, which changes its sign at |x| = 1, step 0.1 s: the events are at 1 and 3 s.",
        "x(2) = 0, x(3) = −1, x(4) = 0", {k: v for k, v in both_solvers(TRIANGLE, 4, 0.1).items() if "FMI 2" in k},
        [*at(0.5, 1e-7, m_x=0.5), *at(2.0, 1e-7, m_x=0.0), *at(3.0, 1e-7, m_x=-1.0), *at(4.0, 1e-7, m_x=0.0)],
        because="solvers at 1e-10 a step, located within 1e-9", peer=peer(TRIANGLE, 4),
    ),
    Case(
        "event-between-communication-points", "event", "The same with steps of 0.16 s.", "x(2.08) = −0.08, x(4) = 0",
        {"": both_solvers(TRIANGLE, 4, 0.16)["FMI 2 me cvode"]}, [*at(2.08, 1e-7, m_x=-0.08), *at(4.0, 1e-7, m_x=0.0)],
        because="solvers at 1e-10 a step, located within 1e-9",
    ),
    Case(
        "event-iteration", "event", "A time event at 0.5 s whose update asks for another one twice; x' = n.",
        "n = 3 after it, x(1) = 1.5", everywhere(ITERATED, kinds=EXCHANGE),
        [*at(0.4, 0, m_n=0), *at(0.5, 0, m_n=3), *at(1.0, 1e-8, m_x=1.5)], because="CVODE at 1e-10 a step",
        peer=peer(ITERATED, 1),
    ),
    Case(
        "step-event", "event",
        "x' = 1; from the first completed integrator step at or after 0.5 s, which asks for an event, −1.",
        "x(1) = 0 up to two solver steps of at most 10 ms",
        {f"FMI {v}": runs(lambda _, v=v: scenario({"m": part(ASKING, v, "me", solver_step=0.01)}, (), 1, 0.5))
            for v in (1, 2, 3)},
        at(1.0, 0.02 + 1e-9, m_x=0.0), because="the event is at the end of a solver step",
    ),
    Case(
        "completed-steps", "event",
        "y is x of 0.1 s before, from a list of completed integrator steps; x = sin t; step 2.5 s.",
        "y(10) = sin 9.9: every step of the integrator is completed (FMI 2.0, 3.2.1), not each communication step",
        {f"FMI {v} {s}": runs(lambda _, v=v, s=s: scenario(
            {"m": part(DELAY, v, "me", solver=s, solver_step=0.02)}, (), 10, 2.5, tolerance=1e-8))
         for v, s in ((1, "cvode"), (2, "cvode"), (2, "solve_ivp"), (3, "cvode"))},
        at(10.0, 2e-4, m_y=math.sin(9.9)), because="linear between steps of 20 ms: h²/8 = 5e-5",
        peer=peer(DELAY, 10, step=2.5),
        differs="y(10) = −0.485, right is −0.458: FMPy completes one step for each communication step.",
    ),
    Case(
        "early-return", "event",
        "x rises by 1 a second and falls to 0 at 0.25 (FMI 3.0, event mode, early return), h = 0.1 s.",
        "the events are at 0.25, 0.5, 0.75, 1 s; x(0.9) = 0.15",
        {"": instants(start={"u": 1, "level": 0.25})},
        [*at(0.2, 0, m_events=0), *at(0.3, 1e-9, m_at=0.25, m_x=0.05), *at(0.9, 1e-9, m_at=0.75, m_x=0.15),
            *at(0.9, 0, m_events=3)],
    ),
    Case(
        "announced-events", "event", "An FMU of FMI 3.0 announces an event each 0.3 s, h = 0.1 s.", "three up to 1 s",
        {"": instants(start={"announced": 0.3})}, [*at(0.8, 0, m_timely=2), *at(1.0, 0, m_timely=3)],
    ),
    Case(
        "periodic-clock", "event", "A clock of 0.1 s, h = 0.1 s.", "⌊t/0.1⌋ + 1 ticks: the first is at the start",
        {"": instants(1, 0.1, CONSTANT)}, [Answer("m.ticks", None, TICKS)],
    ),
    Case(
        "countdown-clock", "event", "A trigger at 0.33 s starts a countdown clock of 0.25 s, h = 0.1 s.",
        "it ticks at 0.58 s",
        {"": instants(1, 0.1, CONSTANT, start={"delay": 0.25}, keys={"clocks": {"trigger": {"at": [0.33]}}})},
        [*at(0.5, m_rung=0.0), *at(0.6, m_rung=0.58)],
    ),
    Case(
        "end-by-the-fmu", "event", "x' = 1; the FMU ends the simulation at 0.5 s.", "the last row is at 0.5 s",
        {name: (lambda folder, run=run: {"end": float((ran := run(folder)).time[-1]), "x": float(ran["m.x"][-1])})
         for name, run in everywhere(ENDING, kinds=ALL[2:]).items()},
        [Answer("end", None, 0.5), Answer("x", None, 0.5, 1e-8)], because="CVODE at 1e-10 a step",
    ),
    Case(
        "zeno", "event", "The ball without an end of its bounces, over their limit √(2/g)(1 + e)/(1 − e) = 2.5586 s.",
        "exit code 4 between the 20th bounce and the limit, and h is never below the ground",
        {solver: stopped(lambda folder, solver=solver: cosim.run(scenario(
            {"m": part(BALL, 2, "me", solver=solver)}, (), 3, 0.05, tolerance=1e-8), folder / "out"), "m.h")
         for solver in ("cvode", "solve_ivp")},
        [Answer("exit code", None, 4, 0), Answer("end", None, 2.53, 0.05), Answer("below m.h", None, 0.0, 1e-6)],
        because="rows of 0.05 s; the solver's tolerance is 1e-8", peer=peer(BALL, 3, step=0.01),
        differs="h(3) = −0.96: the ball falls through the ground. No number is right after 2.5586 s.",
    ),
]  # fmt: skip

# -- start times ------------------------------------------------------------------------------------------

EPOCH = 1.7e9


def epoch_ball(solver: str) -> Callable[[Path], Any]:
    return runs(
        lambda _: scenario({"m": part(BALL, 2, "me", solver=solver)}, (), 1.6, tolerance=1e-10, start_time=EPOCH)
    )


START = [
    Case(
        "negative-start", "start time", "x' = t from −1 s, x(−1) = 0.", "x(t) = (t² − 1)/2: x(0) = −0.5, x(1) = 0",
        everywhere(TIMED, 2, start_time=-1, kinds=OTHERS),
        [Answer("m.now", None, np.arange(21) * 0.1 - 1, 1e-12), *at(0.0, 1e-8, m_x=-0.5), *at(1.0, 1e-8, m_x=0.0)],
        because="CVODE at 1e-10 a step", peer=peer(TIMED, 1, start_time=-1.0),
    ),
    Case(
        "negative-rows", "start time", "x' = u from −1 s; u is 0 and from the row at −0.5 s on 1.", "x(1) = 1.5",
        {way: runs(lambda folder, way=way: scenario(
            {"m": part(PLAIN, 2, way), "r": {"block": "playback",
                "file": table(folder / "u.csv", "time,u", (-1, 0), (-0.5, 1))}},
            ["r.u > m.u"], 2, start_time=-1)) for way in WAYS}
        | {"event": runs(lambda _: scenario({"m": part(PLAIN)}, (), 2, start_time=-1,
                                            events=[{"at": -0.5, "set": {"m.u": 1}}])),
           "reference": runs(lambda _: scenario({"m": part(PLAIN), "r": {"block": "reference", "signals": {
               "u": {"start": 0, "changes": [{"at": -0.5, "to": 1}]}}}}, ["r.u > m.u"], 2, start_time=-1))},
        at(1.0, m_x=1.5),
    ),
    Case(
        "absolute-time-event", "start time", "The time event at 0.35 s in a run from −0.5 s.", "x(1) = 0.85 + 2 · 0.65",
        everywhere(ALARM, 1.5, kinds=EXCHANGE, start_time=-0.5), at(1.0, 1e-8, m_x=2.15),
        because="CVODE at 1e-10 a step",
        peer=peer(ALARM, 1, start_time=-0.5),
    ),
    Case(
        "epoch-start", "start time", "x' = −x from 1 700 000 000 s, x = 1 at the start, h = 0.1 s.",
        "x(1 s later) = e^−1", everywhere(DECAY, start_time=1700000000, tolerance=1e-8),
        [Answer("m.x", 1700000001.0, math.exp(-1), 1e-6)],
        because="times are rounded to 2.4e-7 s", peer=peer(DECAY, 1700000001.0, start_time=1700000000.0),
        differs="one row, x = 1: FMPy ends at once, since its comparison of times is relative, 1e-9 of 1.7e9 s.",
    ),
    Case(
        "epoch-event", "start time", "The ball from 1 700 000 000 s on, by `solve_ivp`.",
        "its third bounce 1.526150 s later",
        {"": epoch_ball("solve_ivp")}, [Answer("m.when", EPOCH + 1.6, EPOCH + bounce(3), 1e-5)],
        because="times are rounded to 2.4e-7 s, at three bounces",
    ),
    Case(
        "epoch-event-cvode", "start time", "The same by CVODE.", "the same", {"": epoch_ball("cvode")},
        [Answer("m.when", EPOCH + 1.6, EPOCH + bounce(3), 1e-5)],
        because="times are rounded to 2.4e-7 s, at three bounces",
    ),
    Case(
        "fractional-start", "start time", "Steps of 0.1 s from 0.05 s.", "rows at 0.05 + 0.1 k, x = t²/2 − 0.00125",
        everywhere(TIMED, 1, start_time=0.05),
        [Answer("m.now", None, 0.05 + np.arange(11) * 0.1, 1e-12), *at(1.05, 1e-8, m_x=0.55)],
        because="CVODE at 1e-10 a step",
    ),
    Case(
        "counted-steps", "start time", "10 000 steps of 0.1 s.", "t_k = 0.1 k, not a sum; no gap between steps",
        {"": runs(lambda _: scenario({"m": part(ACCUMULATED)}, (), 1000, 0.1))},
        [Answer("m.now", 999.9, 0.1 * 9999, 3e-13), *at(1000.0, 3e-13, m_gap=0.0), *at(1000.0, 0, m_n=10000)],
        because="the spacing of doubles at 1000 s is 1.1e-13 s",
    ),
]  # fmt: skip
CASES = [*INTERFACE, *EVENTS, *START]
