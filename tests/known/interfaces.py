"""Interfaces of FMI 1.0, 2.0 and 3.0: start values, parameters, aliases; events; start times."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.instants import CONSTANT, instants_fmu
from tests.known.kit import Model
from tests.known.sources import DIRECT, EPOCH, PLAIN
from tests.known.table import (
    ALL,
    EXCHANGE,
    OTHERS,
    WAYS,
    Case,
    Kinds,
    Run,
    at,
    everywhere,
    failing,
    found,
    jump,
    part,
    put,
    run,
    simulated,
    solved,
)

TWO: Kinds = [(2, "me"), (3, "cs")]
DECAY = Model("x = 1, parameter k = 1", "x' = -k * x")
TUNABLE = Model("x = 1, tunable parameter k = 1", "x' = -k * x")
OWN, OTHER = (
    Model("input u = 0, y", "", "y = y1(u);", DIRECT, functions=f"double y1(double x) {{ return {gain} * x; }}")
    for gain in (2, 3)
)
DERIVED = Model(
    "x = 0, parameter a = 2, parameter b = 3, calculatedParameter area, y",
    "x' = -x",
    "area = a * b; if (initializing) x = area; y = x / area;",
    start="x = area;",
)
INITIAL = Model("input u = 0, local x, y", "x' = -x", "if (initializing) x = 2 * u; y = x;", start="x = 2 * u;",
                initial=DIRECT)  # fmt: skip
ALIASED = Model("x = 1, same:x, parameter k = 1", "x' = -k * x")
NEGATED = Model("input u = 0, flow_out = 6, flow_in:-flow_out", "flow_out' = u")
TWO_NAMES, OPPOSITE = (
    Model(f"input u = 0, input same:{sign}u, input Int32 n = 0, input Int32 nn:{sign}n, x = 0", "x' = u + n")
    for sign in ("", "-")
)


def two_names(model: Model, version: int) -> dict[str, Run]:
    """Return the runs that bring 2 and 3 into the second names of two inputs."""
    bias: dict[str, Any] = {"faults": [{"on": "m.same", "kind": "bias", "value": 1.0}]}
    return {
        f"FMI {version} {way}, {door}": put(
            door, part(model, version, way), {"same": real, "nn": 3}, duration=1.0, step=0.1, **keys
        )
        for way in WAYS
        for door, real, keys in (("start", 2.0, {}), ("event", 2.0, {}), ("playback", 1.0, bias))
    }


TIMED = Model("x = 0, now", "x' = time", "now = time;")
ACCUMULATED = Model(
    "Int32 n = 0, gap = 0, now = 0",
    step="if (n && fabs(t - memory[0]) > gap) gap = fabs(t - memory[0]); memory[0] = t + h; n += 1; now = t + h;",
)

INTERFACE = [  # by CVODE at 1e-10 a step
    Case(
        "decay", "x' = −x, x(0) = 1.", "x(t) = e^−t", everywhere(DECAY, ALL),
        at(None, 2e-9, m_x=np.exp(-np.arange(11) * 0.1)), "same",
    ),
    Case(
        "declared-without-feedthrough",
        "x' = −x feeds z' = u, whose FMU declares that z does not depend directly on u; h = 0.1 s, Gauss-Seidel.",
        "z(1) = 0.1 Σ e^−t_k: each step has the input of its start (coupling.md), in FMI 1.0 too (DirectDependency)",
        {f"FMI {v} {way} after {other}": run(
            {"z": part(PLAIN, v, way), "x": part(DECAY, other, way)}, "x.x > z.u", 1, tolerance=1e-10)
         for v, other in ((1, 2), (2, 1), (3, 1)) for way in WAYS},
        at(1.0, 1e-8, z_x=0.1 * np.exp(-np.arange(10) * 0.1).sum()),
    ),
    Case(
        "default-tolerance", "The same by model exchange with default settings.", "e^−1 within 1e-4",
        run({"m": part(DECAY, 2, "me")}, "", 1, door=simulated), at(1.0, 1e-4, m_x=math.exp(-1)), "same",
    ),
    Case(
        "start-of-a-state", "x' = −x with x = 3 in `start`.", "x(0) = 3, x(1) = 3 e^−1",
        everywhere(DECAY, OTHERS, of_part={"start": {"x": 3}}),
        at(0.0, m_x=3.0) + at(1.0, 1e-8, m_x=3 * math.exp(-1)), "same",
    ),
    Case(
        "tunable", "x' = −k x; the tunable k is 1 and from 0.5 s on 2.", "x(1) = e^−1.5",
        everywhere(TUNABLE, [(2, "cs"), *TWO], events=[{"at": "500 ms", "set": {"m.k": 2}}]),
        at(1.0, 2e-9, m_x=math.exp(-1.5)),
    ),
    Case(
        "calculated-parameter", "x(0) = a b, computed by the FMU; a = 2, b = 5 in `start`; x' = −x.",
        "x(0) = area = 10, x(1) = 10 e^−1: calculated values follow parameters in initialization",
        everywhere(DERIVED, TWO, of_part={"start": {"b": 5}}, record=["m.*"]),
        at(0.0, m_x=10.0, m_area=10.0) + at(1.0, 2e-8, m_x=10 * math.exp(-1), m_y=math.exp(-1)), "same",
    ),
    Case(
        "initial-unknowns", "Three FMUs with y(0) = 2 u(0) and y' = −y in a row, written from the last; u = 3.",
        "24 e^−t: initial values pass through the whole row before time begins",
        {f"FMI {v} {w}": run(
            {"c": part(INITIAL, v, w), "b": part(INITIAL, v, w), "a": part(INITIAL, v, w, start={"u": 3})},
            "b.y > c.u, a.y > b.u", 0.3, tolerance=1e-10) for v, w in TWO},
        at(0.0, a_y=6.0, b_y=12.0, c_y=24.0) + at(0.3, 1e-7, c_y=24 * math.exp(-0.3)),
    ),
    Case(
        "recorded-derivative", "x' = −2 x with `record: [m.*]`.", "der(x)(0) = −2, der(x)(1) = −2 e^−2",
        everywhere(DECAY, of_part={"start": {"k": 2}}, record=["m.*"]),
        at(0.0, m_k=2.0, **{"m_der(x)": -2.0}) + at(1.0, 1e-8, **{"m_der(x)": -2 * math.exp(-2)}),
    ),
    Case(
        "alias", "Two names of one variable of x' = −x.", "both are e^−t", everywhere(ALIASED, OTHERS),
        at(1.0, 2e-9, m_x=math.exp(-1), m_same=math.exp(-1)), "same",
    ),
    Case(
        "negated-alias", "`flow_in` is the negated alias of `flow_out` = 6 + t.", "flow_in = −6 − t (FMI 1.0, alias)",
        everywhere(NEGATED, ALL[:2], of_part={"start": {"u": 1}}),
        at(0.0, m_flow_out=6.0, m_flow_in=-6.0) + at(1.0, 1e-8, m_flow_in=-7.0),
        "flow_in(1) = 7: FMPy does not read the attribute. The standard is right: the value is negated.",
    ),
    Case(
        "negated-alias-connected", "The negated alias −6 − t as input u of x' = u, step 0.1 s.",
        "x(1) = −Σ 0.1 (6 + t_k) = −6.45",
        run({"n": part(NEGATED, 1, start={"u": 1}), "m": part(PLAIN)}, "n.flow_in > m.u", 1), at(1.0, m_x=-6.45),
    ),
    *(
        Case(
            name, f"A Real of 2 and an Int32 of 3 into {names} of the inputs u and n of x' = u + n; the Real comes as "
            "1 with a bias of 1 where it is connected.",
            f"u = {2 * sign}, n = {3 * sign}, x(1) = {5 * sign}: both names have the value of one variable",
            two_names(model, version), at(1.0, 1e-8, m_u=2.0 * sign, m_n=3 * sign, m_same=2.0, m_nn=3, m_x=5.0 * sign),
        )
        for name, names, sign, model, version in (
            ("negated-input", "negated aliases", -1, OPPOSITE, 1), ("same-input", "second names", 1, TWO_NAMES, 2))
    ),
    Case(
        "open-input", "x' = u with u = 0.5 in `start` and no source.", "x(1) = 0.5",
        everywhere(PLAIN, OTHERS, of_part={"start": {"u": 0.5}}), at(1.0, m_x=0.5), "same",
    ),
    Case(
        "own-process", "x' = −x in a process of its own.", "x(1) = e^−1",
        everywhere(DECAY, [(3, "me")], of_part={"process": "own"}), at(1.0, 2e-9, m_x=math.exp(-1)),
    ),
    Case(
        "own-function",
        "y = y1(u) with a function y1(u) = 2 u of the FMU, not static, which libm has too; u = 1.",
        "2: an FMU calls its own functions, not the Bessel function of libm",
        run({"m": part(OWN, start={"u": 1})}, "", 0.2), at(0.2, m_y=2.0),
        "−0.781213, which is Y₁(1): its Python has loaded libm first. The FMU is right.",
    ),
    Case(
        "equal-names", "Two FMUs of one name, whose functions of one name have the gains 2 and 3; u = 1.", "2 and 3",
        run({"a": part(OWN, start={"u": 1}), "b": part(OTHER, start={"u": 1})}, "", 0.2), at(0.2, a_y=2.0, b_y=3.0),
    ),
]  # fmt: skip

# -- events ---------------------------------------------------------------------------------------------

G, E = 9.81, 0.7
FALL = math.sqrt(2 / G)  # from 1 m


BALL = Model(
    "h = 1, v = 0, parameter e = 0.7, Int32 n = 0, discrete when = 0",
    "h' = v, v' = -9.81",
    zeros=("h",),
    event="if (h <= 1e-10 && v < 0) { v = -e * v; h = 0; n += 1; when = time; changed = true; }",
)
ALARM = Model(
    "x = 0, discrete k = 1, Int32 n = 0",
    "x' = k",
    event="if (n == 0) next = 0.35; if (time >= next) { k = 2; n += 1; next = n == 1 ? 0.35 + 1e-9 : INFINITY; }",
)
TRIANGLE = Model(
    "x = 0, discrete s = 1",
    "x' = s",
    zeros=("x - 1", "x + 1"),
    event="if (x >= 1 - 1e-9 && s > 0) s = -1; else if (x <= -1 + 1e-9 && s < 0) s = 1;",
)
ITERATED = Model(
    "Int32 n = 0, x = 0",
    "x' = n",
    event="if (memory[0] == 0) { memory[0] = 1; next = 0.5; } else if (time >= 0.5 && n < 3) { n += 1; more = n < 3; "
    "next = INFINITY; changed = false; }",
)
ASKING = Model(
    "x = 0, discrete k = 1", "x' = k", event="if (time >= 0.5) k = -1;", completed="ask = time >= 0.5 && k > 0;"
)
ENDING = Model("x = 0", "x' = 1", step="end = time >= 0.5 - 1e-9;", event="next = 0.5; end = time >= 0.5;")
HOLD = Model(
    "input u = 0, x = 0, discrete y = 0",
    "x' = y",
    depends=None,
    start="next = 0.25;",
    event="if (!initializing && time >= next - 1e-12) { y = u; next += 0.25; }",
)
HIT = Model(
    "input u = 1, x = 0, discrete y = 0", "x' = 1", depends=None, zeros=("x - 0.5",),
    event="if (x >= 0.5 - 1e-9 && y == 0) y = u;",
)  # fmt: skip
DELAY = Model(  # the last 100 completed steps; y is x of 0.1 s before
    "x = 0, y, Int32 calls = 0",
    "x' = cos(time)",
    "{ int last = calls % 100; double t0 = time - 0.1; y = 0;"
    " double ta = time, xa = x;"
    " for (int k = 0; k < 100 && k < calls; k++) { int i = (calls - 1 - k) % 100;"
    " double tb = memory[i], xb = memory[100 + i];"
    " if (tb <= t0) { y = ta > tb ? xb + (xa - xb) * (t0 - tb) / (ta - tb) : xb; break; } ta = tb; xa = xb; } }",
    completed="{ int i = calls % 100; memory[i] = time; memory[100 + i] = x; calls += 1; }",
)


def bounce(n: int) -> float:
    """Return the time of a bounce, from 1."""
    return FALL * (1 + 2 * sum(E**k for k in range(1, n)))


def height(t: float, n: int) -> float:
    """Return the height at a time, after n bounces."""
    since = t - bounce(n)
    return G * FALL * E**n * since - G * since * since / 2


def both_solvers(model: Model, duration: float, step: float) -> dict[str, Run]:
    """Return the runs of model exchange by CVODE, and one by scipy."""
    return everywhere(model, EXCHANGE, duration, step) | {
        "solve_ivp": everywhere(model, EXCHANGE[1:2], duration, step, of_part={"solver": "solve_ivp"})["FMI 2 me"]
    }


def instants(sample: str | None = None, **keys: Any) -> Run:
    """Return the run of `instants.c`, an FMU of FMI 3.0 with event mode: x rises by u up to `level`."""
    fmu = {"fmu": lambda folder: str(instants_fmu(folder / "i.fmu", sample, updates=sample is None))}
    return run({"m": fmu | {"event_mode": True} | keys}, "", 1)


def last(content: Any, _: Path) -> dict[str, float]:
    ran = cosim.run(content)
    return {"end": ran.time[-1], "x": ran["m.x"][-1]}


def broken_off(content: Any, folder: Path) -> dict[str, float]:
    """Return exit code, last time and how far below the ground the ball is in a run that ends with an error."""
    code = failing(content, folder)
    ran: Any = cosim.read(folder / "out")
    return code | {"end": ran.time[-1], "m.h": min(0, *ran["m.h"])}


def jumping(model: Model, before: float, after: float) -> dict[str, Run]:
    """Return the runs of model exchange whose input jumps at 0.5 s."""
    return {
        f"FMI {version}, step {step} s, {door}, {algorithm}": jump(
            part(model, version, "me"), door, 0.5, before, after, duration=1, step=step, algorithm=algorithm
        )
        for version in (1, 2, 3)
        for step, door, algorithm in (
            (0.25, "playback", "gauss-seidel"),
            (0.05, "reference", "gauss-seidel"),
            (0.05, "event", "gauss-seidel"),
            (0.25, "reference", "jacobi"),
        )
    }


EVENT = [  # by solvers at 1e-10 a step; events are located within 1e-9
    Case(
        "first-bounces", "A ball of e = 0.7 falls from 1 m.", "bounces at √(2/g)(1 + 2 Σ eⁱ): 0.4515, 1.0836, 1.5261 s",
        both_solvers(BALL, 1.6, 0.1),
        at(0.5, 1e-6, m_when=bounce(1), m_h=height(0.5, 1)) + at(1.1, 1e-6, m_when=bounce(2))
        + at(1.6, 1e-6, m_when=bounce(3), m_h=height(1.6, 3)) + at(1.6, 0, m_n=3), "same",
    ),
    Case(
        "time-events", "x' = 1, from the time event at 0.35 s on 2; another time event 1e-9 s later.",
        "x(1) = 0.35 + 2 · 0.65 = 1.65, two events", everywhere(ALARM, EXCHANGE),
        at(1.0, 1e-8, m_x=1.65) + at(1.0, 0, m_n=2), "same",
    ),
    Case(
        "sampled-at-a-jump", "x' = y; y becomes u at time events each 0.25 s; u jumps from 0 to 1 at 0.5 s.",
        "y(0.5) = 1, x(1) = 0.5: of one time, inputs are set before discrete states are updated (FMI 3.0, 3.2)",
        jumping(HOLD, 0, 1), at(0.25, 0, m_y=0.0) + at(0.5, 0, m_y=1.0) + at(1.0, 1e-8, m_x=0.5),
    ),
    Case(
        "state-event-at-a-jump", "x' = 1; y becomes u at x = 0.5; u jumps from 1 to 2 at 0.5 s.",
        "y(1) = 2, as above", jumping(HIT, 1, 2), at(1.0, 0, m_y=2.0),
    ),
    Case(
        "event-on-a-communication-point",
        "x' = s, which changes its sign at |x| = 1, step 0.1 s: the events are at 1 and 3 s.",
        "x(2) = 0, x(3) = −1, x(4) = 0", solved(TRIANGLE, 4, 0.1),
        at(0.5, 1e-7, m_x=0.5) + at(2.0, 1e-7, m_x=0.0) + at(3.0, 1e-7, m_x=-1.0) + at(4.0, 1e-7, m_x=0.0), "same",
    ),
    Case(
        "event-between-communication-points", "The same with steps of 0.16 s.", "x(2.08) = −0.08, x(4) = 0",
        solved(TRIANGLE, 4, 0.16)["cvode"], at(2.08, 1e-7, m_x=-0.08) + at(4.0, 1e-7, m_x=0.0),
    ),
    Case(
        "event-iteration", "A time event at 0.5 s whose update asks for another one twice; x' = n.",
        "n = 3 after it, x(1) = 1.5", everywhere(ITERATED, EXCHANGE),
        at(0.4, 0, m_n=0) + at(0.5, 0, m_n=3) + at(1.0, 1e-8, m_x=1.5), "same",
    ),
    Case(
        "step-event",
        "x' = 1; from the first completed integrator step at or after 0.5 s, which asks for an event, −1.",
        "x(1) = 0 up to two solver steps of at most 10 ms",
        everywhere(ASKING, EXCHANGE, 1, 0.5, of_part={"solver_step": 0.01}), at(1.0, 0.02 + 1e-9, m_x=0.0),
    ),
    Case(
        "completed-steps", "y is x of 0.1 s before, from a list of completed integrator steps; x = sin t; step 2.5 s.",
        "y(10) = sin 9.9: every step of the integrator is completed (FMI 2.0, 3.2.1), not each communication step",
        {f"FMI {v} {solver}": run({"m": part(DELAY, v, "me", solver=solver, solver_step=0.02)}, "", 10, 2.5,
                                  tolerance=1e-8)
         for v, solver in ((1, "cvode"), (3, "cvode"), (2, "solve_ivp"), (2, "cvode"))},
        at(10.0, 2e-4, m_y=math.sin(9.9)),  # linear between steps of 20 ms: h²/8 = 5e-5
        "y(10) = −0.485, right is −0.458: FMPy completes one step for each communication step.",
    ),
    Case(
        "early-return", "x rises by 1 a second and falls to 0 at 0.25 (FMI 3.0, event mode, early return), h = 0.1 s.",
        "the events are at 0.25, 0.5, 0.75, 1 s; x(0.9) = 0.15", instants(start={"u": 1, "level": 0.25}),
        at(0.2, 0, m_events=0) + at(0.3, m_at=0.25, m_x=0.05) + at(0.9, m_at=0.75, m_x=0.15) + at(0.9, 0, m_events=3),
    ),
    Case(
        "announced-events", "An FMU of FMI 3.0 announces an event each 0.3 s, h = 0.1 s.", "three up to 1 s",
        instants(start={"announced": 0.3}), at(0.8, 0, m_timely=2) + at(1.0, 0, m_timely=3),
    ),
    Case(
        "periodic-clock", "A clock of 0.1 s, h = 0.1 s.", "⌊t/0.1⌋ + 1 ticks: the first is at the start",
        instants(CONSTANT), at(None, m_ticks=np.arange(1.0, 12)),
    ),
    Case(
        "countdown-clock", "A trigger at 0.33 s starts a countdown clock of 0.25 s, h = 0.1 s.", "it ticks at 0.58 s",
        instants(CONSTANT, start={"delay": 0.25}, clocks={"trigger": {"at": [0.33]}}),
        at(0.5, m_rung=0.0) + at(0.6, m_rung=0.58),
    ),
    Case(
        "end-by-the-fmu", "x' = 1; the FMU ends the simulation at 0.5 s.", "the last row is at 0.5 s",
        everywhere(ENDING, ALL[2:], door=last), found({"end": 0.5}) + found({"x": 0.5}, 1e-8),
    ),
    Case(
        "zeno", "The ball without an end of its bounces, over their limit √(2/g)(1 + e)/(1 − e) = 2.5586 s.",
        "exit code 4 between the 20th bounce and the limit, and h is never below the ground",
        {solver: run({"m": part(BALL, 2, "me", solver=solver)}, "", 3, 0.05, broken_off, tolerance=1e-8)
         for solver in ("cvode", "solve_ivp")},
        found({"exit code": 4}, 0) + found({"end": 2.53}, 0.05) + found({"m.h": 0.0}, 1e-6),
        "h(3) = −0.96: the ball falls through the ground. No number is right after 2.5586 s.",
    ),
]  # fmt: skip

# -- start times ------------------------------------------------------------------------------------------


def epoch_ball(solver: str) -> Run:
    return run({"m": part(BALL, 2, "me", solver=solver)}, "", 1.6, tolerance=1e-10, start_time=EPOCH)


THIRD = at(EPOCH + 1.6, 1e-5, m_when=EPOCH + bounce(3))  # times are rounded to 2.4e-7 s, at three bounces
START = [
    Case(
        "negative-start", "x' = t from −1 s, x(−1) = 0.", "x(t) = (t² − 1)/2: x(0) = −0.5, x(1) = 0",
        everywhere(TIMED, OTHERS, 2, start_time=-1),
        at(None, 1e-12, m_now=np.arange(21) * 0.1 - 1) + at(0.0, 1e-8, m_x=-0.5) + at(1.0, 1e-8, m_x=0.0), "same",
    ),
    Case(
        "negative-rows", "x' = u from −1 s; u is 0 and from the row at −0.5 s on 1.", "x(1) = 1.5",
        {f"{way}, {door}": jump(part(PLAIN, 2, way), door, -0.5, start_time=-1)
         for way in WAYS for door in ("playback", "event", "reference")},
        at(1.0, m_x=1.5),
    ),
    Case(
        "absolute-time-event", "The time event at 0.35 s in a run from −0.5 s.", "x(1) = 0.85 + 2 · 0.65",
        everywhere(ALARM, EXCHANGE, 1.5, start_time=-0.5), at(1.0, 1e-8, m_x=2.15), "same",
    ),
    Case(
        "epoch-start", "x' = −x from 1 700 000 000 s, x = 1 at the start, h = 0.1 s.", "x(1 s later) = e^−1",
        everywhere(DECAY, start_time=EPOCH, tolerance=1e-8),
        at(EPOCH + 1.0, 1e-6, m_x=math.exp(-1)),  # times are rounded to 2.4e-7 s
        "one row, x = 1: FMPy ends at once, since its comparison of times is relative, 1e-9 of 1.7e9 s.",
    ),
    Case(
        "epoch-event", "The ball from 1 700 000 000 s on, by `solve_ivp`.", "its third bounce 1.526150 s later",
        epoch_ball("solve_ivp"), THIRD,
    ),
    Case("epoch-event-cvode", "The same by CVODE.", "the same", epoch_ball("cvode"), THIRD),
    Case(
        "fractional-start", "Steps of 0.1 s from 0.05 s.", "rows at 0.05 + 0.1 k, x = t²/2 − 0.00125",
        everywhere(TIMED, start_time=0.05),
        at(None, 1e-12, m_now=0.05 + np.arange(11) * 0.1) + at(1.05, 1e-8, m_x=0.55),
    ),
    Case(
        "counted-steps", "10 000 steps of 0.1 s.", "t_k = 0.1 k, not a sum; no gap between steps",
        run({"m": part(ACCUMULATED)}, "", 1000),
        # the spacing of doubles at 1000 s is 1.1e-13 s
        at(999.9, 3e-13, m_now=0.1 * 9999) + at(1000.0, 3e-13, m_gap=0.0) + at(1000.0, 0, m_n=10000),
    ),
]  # fmt: skip
