"""Coupled systems: recurrences of the algorithms, several rates, controlled steps, solvers, algebraic loops."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm

import cosim
from tests.known.kit import Model, Way
from tests.known.sources import DIRECT, PLAIN
from tests.known.table import ALGORITHMS, WAYS, Answer, Case, Run, at, failing, found, part, reference, run, solved

# -- two masses: 1 kg on a wall (10 N/m, 0.1 Ns/m), 0.5 kg on the first (4 N/m, 0.2 Ns/m) -------------

MASS = Model("input F = 0, x = 1, v = 0", "x' = v, v' = F - 10 * x - 0.1 * v")
HUNG = Model(  # output: force on the first mass
    "input x1 = 1, input v1 = 0, F, x = 0, local v = 0",
    "x' = v, v' = -2 * F",
    "F = 4 * (x - x1) + 0.2 * (v - v1);",
    {"F": ("x1", "v1")},
)
LEFT = Model(
    "input xo = 0, input vo = 0, x = 1, v = 0", "x' = v, v' = -10 * x - 0.1 * v + 4 * (xo - x) + 0.2 * (vo - v)"
)
RIGHT = Model("input xo = 1, input vo = 0, x = 0, v = 0", "x' = v, v' = (4 * (xo - x) + 0.2 * (vo - v)) / 0.5")
MASSES = {"b": part(HUNG), "a": part(MASS)}  # in the file from the last to the first
FORCE = "a.x > b.x1, a.v > b.v1, b.F > a.F"
BY_FORCE = (MASSES, FORCE)
DISPLACEMENTS = "a.x > b.xo, a.v > b.vo, b.x > a.xo, b.v > a.vo"
BY_DISPLACEMENT = ({"a": part(LEFT), "b": part(RIGHT)}, DISPLACEMENTS)
A1 = np.array([[0, 1], [-10, -0.1]])  # mass 1 without the spring between the masses
A2 = np.array([[0, 1], [-8, -0.4]])  # mass 2, x1 and v1 held
WHOLE = np.array([[0, 1, 0, 0], [-14, -0.3, 4, 0.2], [0, 0, 0, 1], [8, 0.4, -8, -0.4]])


def held(a: Any, b: Any, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Φ and Γ of x' = A x + B u with u held for h, by the exponential of [A B; 0 0]."""
    n, m = len(a), len(b[0])
    block = expm(h * np.block([[a, np.asarray(b)], [np.zeros((m, n + m))]]))
    return block[:n, :n], block[:n, n:]


def columns(names: str, rows: Iterable[tuple[float, ...]], tolerance: float = 1e-9) -> list[Answer]:
    """Return answers of whole columns, by rows."""
    return found(dict(zip(names.split(), np.array([*rows]).T, strict=True)), tolerance)


def two_masses(gauss_seidel: bool, tolerance: float) -> list[Answer]:
    """Return x of both masses, coupled by force and displacement with held inputs."""
    phi1, gamma1 = held(A1, [[0], [1]], 0.05)
    phi2, gamma2 = held(A2, [[0, 0], [8, 0.4]], 0.05)
    first, second, seen, rows = np.array([1.0, 0.0]), np.zeros(2), np.array([1.0, 0.0]), []
    for _ in range(41):
        force = 4 * (second[0] - seen[0]) + 0.2 * (second[1] - seen[1])
        rows.append((first[0], second[0], force))
        before, first = first, phi1 @ first + gamma1[:, 0] * force
        seen = first if gauss_seidel else before
        second = phi2 @ second + gamma2 @ seen
    return columns("a.x b.x b.F", rows, tolerance)


def exact(t: float) -> np.ndarray:
    """Return x1, v1, x2, v2 of both masses in one system."""
    return np.asarray(expm(WHOLE * t)[:, 0])


def interpolating(**models: Model) -> Any:
    """Return components of models that declare to interpolate their inputs."""
    return {name: part(replace(model, interpolates=True)) for name, model in models.items()}


def order(content: Any, _: Path) -> dict[str, float]:
    """Return the order of the error at 2 s, by steps of 0.02 and 0.01 s."""
    errors = []
    for step in (0.02, 0.01):
        ran = cosim.run(content | {"step": step})
        errors.append(math.hypot(ran["a.x"][-1] - exact(2)[0], ran["b.x"][-1] - exact(2)[2]))
    return {"order": math.log2(errors[0] / errors[1])}


GAIN = Model("input u = 0, y, parameter k = 1, parameter c = 0", "", "y = k * u + c;", DIRECT)
UNDECLARED_GAIN = replace(GAIN, depends=None)
STEP = reference(0, {"at": 0.5, "to": 1})


def chain(algorithm: str) -> Run:
    gains = {f"g{k}": part(GAIN, start={"k": 2}) for k in (3, 2, 1)}  # in the file from the last to the first
    return run(gains | {"r": STEP}, "g2.y > g3.u, g1.y > g2.u, r.u > g1.u", 1, algorithm=algorithm)


def doubled(delay: int) -> list[Answer]:
    """Return 2, 4, 8 from row 5 on, each later than the one before by some rows."""
    return found({f"g{n}.y": 2**n * (np.arange(11) >= 5 + delay * (n - 1)).astype(float) for n in (1, 2, 3)})


COUPLING = [
    Case(
        "two-masses-gauss-seidel", "Two masses, coupled by force and displacement, h = 0.05 s, Gauss-Seidel.",
        "the recurrence by matrix exponentials, the second FMU after the first",
        {"": run(*BY_FORCE, 2, 0.05),
         "model exchange": run({"b": part(HUNG, 3, "me"), "a": part(MASS, 2, "me")}, FORCE, 2, 0.05, tolerance=1e-11)},
        two_masses(True, 1e-7),  # model exchange: CVODE at 1e-11 a step
    ),
    Case(
        "two-masses-jacobi", "The same by Jacobi.", "the recurrence, both with values of the step's start",
        {"": run(*BY_FORCE, 2, 0.05, algorithm="jacobi"),
         "own process": run({k: v | {"process": "own"} for k, v in MASSES.items()}, FORCE, 2, 0.05,
                            algorithm="jacobi")},
        two_masses(False, 1e-9),
    ),
    Case(
        "held-order", "Two masses, coupled by displacements, held inputs.",
        "the error against both masses in one system (matrix exponential) is of order 1",
        run(*BY_DISPLACEMENT, door=order), found({"order": 1.0}, 0.2),  # terms of higher order, as below
    ),
    Case(
        "linear-order", "The same with `extrapolate: linear`.", "order 2",
        run(*BY_DISPLACEMENT, door=order, extrapolate="linear"), found({"order": 2.0}, 0.3),
    ),
    Case(
        "quadratic-order", "The same with `extrapolate: quadratic`, by means: positions are of order 2.",
        "order 2", run(*BY_DISPLACEMENT, door=order, extrapolate="quadratic"), found({"order": 2.0}, 0.3),
    ),
    Case(
        "quadratic-order-by-derivatives", "The same with FMUs that interpolate their inputs.",
        "order 3, as coupling.md says",
        {"displacements": run(interpolating(a=LEFT, b=RIGHT), DISPLACEMENTS, door=order, extrapolate="quadratic"),
         "jacobi": run(interpolating(b=HUNG, a=MASS), FORCE, door=order, algorithm="jacobi",
                       extrapolate="quadratic")},
        found({"order": 3.0}, 0.4),
    ),
    Case(
        "ignored-derivatives", "The same with FMUs that declare to interpolate their inputs and ignore derivatives.",
        "order 2 by the means",
        run(interpolating(a=replace(LEFT, functions="#define IGNORES_SLOPES"),
                          b=replace(RIGHT, functions="#define IGNORES_SLOPES")), DISPLACEMENTS, door=order,
            extrapolate="quadratic"), found({"order": 2.0}, 0.3),
    ),
    Case(
        "jacobi-linear-order", "Two masses, coupled by force, `jacobi`, `extrapolate: linear`.",
        "order 2, as coupling.md says", run(*BY_FORCE, door=order, algorithm="jacobi", extrapolate="linear"),
        found({"order": 2.0}, 0.3),
    ),
    Case(
        "gauss-seidel-linear-order", "Two masses, coupled by force, Gauss-Seidel, both courses linear.",
        "order 2, as coupling.md says", run(*BY_FORCE, door=order, extrapolate="linear", interpolate="linear"),
        found({"order": 2.0}, 0.3),
    ),
    Case(
        "chain-gauss-seidel", "Three gains of 2 in a row, written from the last to the first; a step at 0.5 s.",
        "8 from 0.5 s on: a chain of direct feedthrough has no delay", chain("gauss-seidel"), doubled(0),
    ),
    Case(
        "chain-jacobi", "The same by Jacobi.",
        "2 from 0.5 s, 4 from 0.6 s, 8 from 0.7 s on: the source has no delay; FMUs see each other's last row",
        chain("jacobi"), doubled(1),
    ),
    Case(
        "factor-and-offset", "y = 3 through a connection with factor 2 and offset −1.", "u = 2 · 3 − 1 = 5",
        {algorithm: run({"a": part(GAIN, start={"c": 3}), "b": part(GAIN)},
                        {"a.y > b.u": {"factor": 2, "offset": -1}}, 0.2, algorithm=algorithm)
         for algorithm in ALGORITHMS},
        at(0.0, b_u=5.0, b_y=5.0) + at(0.2, b_u=5.0, b_y=5.0),
    ),
    Case(
        "freeze-and-scale", "x = t through connections with `scale` of 3 from 1 s, and `freeze` from 0.5 to 1 s.",
        "3 t from 1 s on; 0.4 from 0.5 to 1 s: the last value before the fault",
        run({"i": part(PLAIN, start={"u": 1}), "s": part(GAIN), "f": part(GAIN)}, "i.x > s.u, i.x > f.u",
            faults=[{"on": "s.u", "kind": "scale", "from": 1, "value": 3},
                    {"on": "f.u", "kind": "freeze", "from": 0.5, "to": 1}]),
        at(0.9, s_u=0.9) + at(1.0, s_u=3.0, f_u=0.4) + at(0.5, f_u=0.4) + at(1.1, f_u=1.1),
    ),
]  # fmt: skip

# -- several rates -----------------------------------------------------------------------------------

FAST = Model("input u = 0, x = 1", "x' = -x + u")
SLOW = Model("input w = 0, z = 0", "z' = -2 * z + w")
SLOW_DIRECT = Model("input w = 0, z = 0, y", "z' = -2 * z + w", "y = z + w;", {"y": ("w",)})
COUNTER = Model("Int32 n = 0, discrete seen = 0", step="n += 1; seen = t + h;",
                any_step=False)  # fmt: skip
STEPS = np.floor(np.arange(21) / 5 + 1e-9)  # of 0.25 s in rows of 0.05 s


def slow(model: Model = SLOW, version: int = 2, way: Way = "cs") -> Run:
    """Return the run of a fast FMU with steps of 0.1 s and a slow one with 0.5 s."""
    components = {"a": part(FAST, version, way), "b": part(model, 2, way, step=0.5)}
    return run(components, f"b.{'z' if model is SLOW else 'y'} > a.u, a.x > b.w", tolerance=1e-10)


def rates(direct: bool) -> list[Answer]:
    """Return rows of the fast FMU (0.1 s) and of the slow one (0.5 s)."""
    f, s = math.exp(-0.1), math.exp(-1)
    x, z, w, rows = 1.0, 0.0, 1.0, []
    out = float(direct)
    for k in range(21):
        rows.append((x, z))
        x = f * x + (1 - f) * out
        if k % 5 == 4:
            w = x if direct else w
            z = s * z + (1 - s) / 2 * w
            out = z + w * direct
            w = x
    return columns("a.x b.z", rows, 1e-8)  # model exchange: CVODE at 1e-10 a step


MULTI_RATE = [
    Case(
        "slow-without-feedthrough", "x' = −x + z each 0.1 s, z' = −2 z + x with `step: 0.5`.",
        "the recurrence: the slow step is made at its end from the input at its start; until then z is constant",
        {"": slow(), "model exchange": slow(way="me")}, rates(False),
    ),
    Case(
        "slow-without-feedthrough-1", "The same, with a fast FMU of FMI 1.0 that declares no DirectDependency.",
        "the same: an empty DirectDependency is no feedthrough (FMI 1.0)", slow(version=1), rates(False),
    ),
    Case(
        "slow-with-feedthrough", "The same, with y = z + x of the slow FMU as input of the fast one.",
        "the slow step is made from the input at its end", slow(SLOW_DIRECT), rates(True),
    ),
    Case(
        "sampled-counter", "An FMU that counts its steps, `step: 0.25`, beside steps of 0.05 s.",
        "n = ⌊t / 0.25⌋, and the time that it has seen is 0.25 n",
        run({"c": part(COUNTER, step=0.25), "i": part(PLAIN)}, "", 1, 0.05), at(None, c_n=STEPS, c_seen=0.25 * STEPS),
    ),
    Case(
        "sampled-sensor", "A `fix` of x = t at 2 Hz with a latency of 0.1 s.",
        "the sample of 0.5 s appears at 0.6 s and holds until 1.1 s",
        run({"i": part(PLAIN, start={"u": 1}), "s": {"block": "fix", "rate": 2, "latency": 0.1, "signals": {"x": {}}},
             "g": part(GAIN)}, "i.x > s.x, s.x_meas > g.u"),
        at(0.5, g_u=0.0) + at(0.6, g_u=0.5) + at(1.0, g_u=0.5) + at(1.1, g_u=1.0),
    ),
    Case(
        "recorded-part", "x = t with steps of 0.01 s and `record: {every: 0.5}`.", "rows at 0, 0.5, 1, 1.2 s",
        run({"i": part(PLAIN, start={"u": 1})}, "", 1.2, 0.01, record={"every": 0.5, "signals": ["i.x"]}),
        at(None, i_x=np.array([0, 0.5, 1, 1.2])),
    ),
]  # fmt: skip

# -- controlled steps and solvers ---------------------------------------------------------------------

VDP = Model("x = 2, y = 0, parameter mu = 1", "x' = y, y' = mu * (1 - x * x) * y - x")
ROBERTSON = Model(
    "x = 1, y = 0, z = 0",
    "x' = -0.04 * x + 1e4 * y * z, y' = 0.04 * x - 1e4 * y * z - 3e7 * y * y, z' = 3e7 * y * y",
)
DRIVEN = Model("x = 0", "x' = cos(time)")


def controlled(masses: tuple[Any, str], **step: Any) -> Run:
    return run(*masses, 2, {"max": 0.1, "min": 1e-5, **step})


CONTROL = [
    Case(
        "controlled-steps", "Two masses, steps controlled by `halving` and `residual` at 1e-6 and 1e-4.",
        "both masses in one system, by the matrix exponential, at rows of 0.1 s",
        {"halving": controlled(BY_DISPLACEMENT, tolerance=1e-6, estimator="halving"),
         "residual": controlled(BY_DISPLACEMENT, tolerance=1e-4, estimator="residual")},
        # errors of some hundred steps at the tolerance add up
        [a for t in (0.5, 1.0, 1.5, 2.0) for a in at(t, 1e-4, a_x=exact(t)[0])] + at(2.0, 1e-4, b_x=exact(2)[2]),
    ),
    Case(
        "energy-steps", "Two masses, coupled by force and velocity, steps controlled by `energy` at 1e-4.", "as above",
        controlled(BY_FORCE, tolerance=1e-4, estimator="energy", bonds=[{"effort": "b.F", "flow": "a.v"}]),
        # the energy residual does not see errors near zero power (coupling.md)
        at(2.0, 2e-3, a_x=exact(2)[0], b_x=exact(2)[2]),
    ),
    Case(
        "van-der-pol", "x'' = (1 − x²) x' − x by model exchange.", "DOP853 of scipy at 1e-12, 10 s",
        solved(VDP, 10, 0.5, 1e-9), at(10.0, 2e-6, m_x=-2.008340782580), "same",  # 1e-9 a step, some 400 steps
    ),
    Case(
        "stiff-van-der-pol", "The same with μ = 1000.", "x(2000) = 1.706167732170483 (test set for IVP solvers)",
        {"cvode": solved(VDP, 2000, 100, 1e-9, start={"mu": 1000}, max_steps=100000)["cvode"],
         "solve_ivp": solved(VDP, 2000, 100, 1e-8, start={"mu": 1000})["solve_ivp"]},
        at(2000.0, 1e-6, m_x=1.706167732170483),  # 1e-8 a solver step
    ),
    Case(
        "robertson", "Robertson's reaction, with rates from 0.04 to 3·10⁷ 1/s, by model exchange.",
        "Radau of scipy at 1e-12, 40 s: x = 0.715827", solved(ROBERTSON, 40, 4, 1e-8),
        at(40.0, 1e-6, m_x=0.715827068720) + at(40.0, 1e-10, m_y=9.185534764578e-6), "same",  # 1e-8 a solver step
    ),
    Case(
        "rate-of-time", "x' = cos t by model exchange, and by co-simulation.", "x = sin t",
        {"cs": run({"m": part(DRIVEN)}, "", 10, 0.5)} | solved(DRIVEN, 10, 0.5),
        at(None, 1e-7, m_x=np.sin(np.arange(21) * 0.5)), "same",  # 1e-10 a solver step
    ),
]  # fmt: skip

# -- algebraic loops -----------------------------------------------------------------------------------


def loop(first: dict[str, Any], second: dict[str, Any], model: Model = GAIN, other: Model = GAIN, *, way: Way = "cs",
         **keys: Any) -> Run:  # fmt: skip
    """Return the run of two FMUs that need each other's output."""
    components = {"a": part(model, 2, way, start=first), "b": part(other, 2, way, start=second)}
    return run(components, "a.y > b.u, b.y > a.u", 1, **keys)


STEEP = ({"k": 3, "c": 1}, {"k": 1})
FOLLOWS = Model(
    "input u = 0, y, parameter k = 1, parameter c = 0, discrete local s = 0",
    "",
    "if (initializing) s = k * u + c; y = s;",
    None,
    "s = k * u + c;",
    "s -= h * s;",
)
FOLLOWS_DECLARED = replace(FOLLOWS, depends={}, initial={"y": ("u", "k", "c")})
SQUARE = replace(GAIN, calc="y = k * u * u + c;")
EXPONENTIAL = replace(GAIN, calc="y = k * exp(-u) + c;")
FILTER = Model("input u = 0, x = 1, y", "x' = -x + u", "y = x + 0.5 * u;", DIRECT)
PAIR = Model(
    "input u1 = 0, input u2 = 0, y, parameter k1 = 0, parameter k2 = 0, parameter c = 0",
    "",
    "y = k1 * u1 + k2 * u2 + c;",
    {"y": ("u1", "u2")},
)
MATRIX = np.array([[0, 0.3, -0.7], [2.0, 0, 0.4], [-0.5, 1.5, 0]])
RIGHT_SIDE = np.array([1.0, -2.0, 0.5])
SOLUTION = np.linalg.solve(np.eye(3) - MATRIX, RIGHT_SIDE)
SUM = Model("input u = 0, input r = 0, y", "", "y = 0.5 * u + r;", {"y": ("u", "r")})


def three(**keys: Any) -> Run:
    """Return the run of y = M y + c in three FMUs."""
    components, wires = {}, []
    for k, (i, j) in enumerate(((1, 2), (0, 2), (0, 1))):
        components[f"f{k}"] = part(PAIR, start={"k1": MATRIX[k, i], "k2": MATRIX[k, j], "c": RIGHT_SIDE[k]})
        wires += [f"f{i}.y > f{k}.u1", f"f{j}.y > f{k}.u2"]
    return run(components, ", ".join(wires), 0.5, **keys)


def opened() -> list[Answer]:
    """Return rows of a = b/2 + 1 with b of the row before, b = a/2 + r; r is 1 from 0.5 s on."""
    rows = [(4 / 3, 2 / 3)]
    for k in range(1, 11):
        a = rows[-1][1] / 2 + 1
        rows.append((a, a / 2 + (k >= 5)))
    return columns("a.y b.y", rows)


LOOPS = [  # the tolerance of a loop is 1e-8
    Case(
        "steep-loop", "a = 3 b + 1, b = a: a loop gain of 3.", "a = −0.5: loops are solved, not iterated",
        {"declared": loop(*STEEP), "undeclared": loop(*STEEP, UNDECLARED_GAIN, UNDECLARED_GAIN),
         "model exchange": loop(*STEEP, way="me")},
        at(0.0, 1e-7, a_y=-0.5, b_y=-0.5) + at(1.0, 1e-7, a_y=-0.5, b_y=-0.5),
    ),
    Case(
        "three-in-a-loop", "y = M y + c in three FMUs, with a loop gain above 1.", "(I − M)⁻¹ c by numpy",
        {"newton": three(), "anderson": three(loops={"method": "anderson"})},
        at(0.5, 1e-7, **{f"f{k}_y": value for k, value in enumerate(SOLUTION)}),
    ),
    Case(
        "loop-at-initialization",
        "y = k u + c in initialization, later y decays by 10 % a step; a: k = 3, c = 1; b: k = 1.",
        "a(0) = −0.5, a(1) = −0.5 · 0.9¹⁰",
        {"undeclared": loop(*STEEP, FOLLOWS, FOLLOWS), "undeclared, loops": loop(*STEEP, FOLLOWS, FOLLOWS, loops={}),
         "declared": loop(*STEEP, FOLLOWS_DECLARED, FOLLOWS_DECLARED),
         "declared, loops": loop(*STEEP, FOLLOWS_DECLARED, FOLLOWS_DECLARED, loops={})},
        at(0.0, 1e-7, a_y=-0.5, b_y=-0.5) + at(1.0, 1e-7, a_y=-0.5 * 0.9**10),
    ),
    Case(
        "double-root", "a = b² + 1/4, b = a.", "a = 1/2, a double root", loop({"c": 0.25}, {}, SQUARE),
        # a residual of 1e-8 belongs to an error of 1e-4 at a double root
        at(0.0, 1e-3, a_y=0.5) + at(1.0, 1e-3, a_y=0.5),
    ),
    Case(
        "omega-constant", "a = exp(−b), b = a.", "0.5671432904097838 (DLMF 4.13)",
        {"": loop({}, {}, EXPONENTIAL), "model exchange": loop({}, {}, EXPONENTIAL, way="me")},
        at(0.0, 1e-7, a_y=0.5671432904097838) + at(1.0, 1e-7, a_y=0.5671432904097838),
    ),
    Case(
        "loop-with-a-state", "x' = −x + u, y = x + u/2 and u = y/2 in two FMUs, h = 0.1 s.",
        "u = 2 x/3, so x_k = (e^−h + (1 − e^−h)·2/3)^k: the input of a step is that of its start",
        {way: loop({}, {"k": 0.5}, FILTER, way=way, tolerance=1e-11) for way in WAYS},
        at(None, 1e-7, a_x=(math.exp(-0.1) + (1 - math.exp(-0.1)) * 2 / 3) ** np.arange(11.0)),
    ),
    Case(
        "loop-gain-1", "a = b + 1, b = a: no solution.", "exit code 4", loop({"c": 1}, {}, door=failing),
        found({"exit code": 4}, 0),
    ),
    Case(
        "open-loop", "a = b/2 + 1, b = a/2 + r with `order: [a, b]`; r is 1 from 0.5 s on.",
        "a_k = b_k−1 / 2 + 1, b_k = a_k / 2 + r_k",
        run({"a": part(GAIN, start={"k": 0.5, "c": 1}), "b": part(SUM), "r": STEP},
            "b.y > a.u, a.y > b.u, r.u > b.r", 1, order=["a", "b"]),
        opened(),
    ),
]  # fmt: skip
