"""Coupled systems: recurrences of the algorithms, several rates, controlled steps, solvers, algebraic loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import cosim
from cosim.core.errors import SimulationError
from tests.known.kit import Model, V, p, u
from tests.known.sources import PLAIN
from tests.known.table import Answer, Case, Peer, at, part, runs, scenario

# -- two masses: 1 kg on a wall (10 N/m, 0.1 Ns/m), 0.5 kg on the first (4 N/m, 0.2 Ns/m) -------------

MASS = Model(
    "mass", (u("F"), V("x", start=1.0), V("v", start=0.0)), {"x": "v", "v": "F - 10 * x - 0.1 * v"}, depends={}
)
HUNG = Model(  # output: force on the first mass
    "hung",
    (u("x1", 1.0), u("v1"), V("F"), V("x", start=0.0), V("v", "local", start=0.0)),
    {"x": "v", "v": "-2 * F"},
    "F = 4 * (x - x1) + 0.2 * (v - v1);",
    depends={"F": ("x1", "v1"), "x": ()},
)
LEFT = Model(
    "left",
    (u("xo"), u("vo"), V("x", start=1.0), V("v", start=0.0)),
    {"x": "v", "v": "-10 * x - 0.1 * v + 4 * (xo - x) + 0.2 * (vo - v)"},
    depends={},
)
RIGHT = Model(
    "right",
    (u("xo", 1.0), u("vo"), V("x", start=0.0), V("v", start=0.0)),
    {"x": "v", "v": "(4 * (xo - x) + 0.2 * (vo - v)) / 0.5"},
    depends={},
)
FORCE = ["a.x > b.x1", "a.v > b.v1", "b.F > a.F"]
DISPLACEMENT = ["a.x > b.xo", "a.v > b.vo", "b.x > a.xo", "b.v > a.vo"]
A1 = np.array([[0, 1], [-10, -0.1]])  # mass 1 without the spring between the masses
A2 = np.array([[0, 1], [-8, -0.4]])  # mass 2, x1 and v1 held
WHOLE = np.array([[0, 1, 0, 0], [-14, -0.3, 4, 0.2], [0, 0, 0, 1], [8, 0.4, -8, -0.4]])


def held(matrix: Any, inputs: Any, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Φ and Γ of x' = A x + B u with u held for h, by the exponential of [A B; 0 0]."""
    a, b = np.atleast_2d(np.asarray(matrix, float)), np.atleast_2d(np.asarray(inputs, float))
    n, m = b.shape
    block = expm(h * np.block([[a, b], [np.zeros((m, n + m))]]))
    return block[:n, :n], block[:n, n:]


def two_masses(gauss_seidel: bool, h: float, steps: int) -> dict[str, np.ndarray]:
    """Return x of both masses, coupled by force and displacement with held inputs."""
    phi1, gamma1 = held(A1, [[0], [1]], h)
    phi2, gamma2 = held(A2, [[0, 0], [8, 0.4]], h)
    first, second = np.array([1.0, 0.0]), np.array([0.0, 0.0])
    force = 4 * (second[0] - first[0]) + 0.2 * (second[1] - first[1])
    rows = [(first[0], second[0], force)]
    for _ in range(steps):
        before, first = first, phi1 @ first + gamma1[:, 0] * force
        seen = first if gauss_seidel else before
        second = phi2 @ second + gamma2 @ seen
        force = 4 * (second[0] - seen[0]) + 0.2 * (second[1] - seen[1])
        rows.append((first[0], second[0], force))
    return dict(zip(("a.x", "b.x", "b.F"), np.array(rows).T, strict=True))


def columns(values: dict[str, np.ndarray], tolerance: float = 1e-9) -> list[Answer]:
    return [Answer(name, None, value, tolerance) for name, value in values.items()]


def exact(t: float) -> np.ndarray:
    """Return x1, v1, x2, v2 of both masses in one system."""
    return np.asarray(expm(WHOLE * t) @ [1, 0, 0, 0])


def order_of(kind: str, h: float = 0.02, **keys: Any) -> Callable[[Path], Any]:
    """Return the run that measures the order of the error at 2 s."""

    def measure(_: Path) -> dict[str, float]:
        errors = []
        for step in (h, h / 2):
            ran = cosim.run(scenario(masses(kind), FORCE if kind == "force" else DISPLACEMENT, 2, step, **keys))
            errors.append(math.hypot(ran["a.x"][-1] - exact(2)[0], ran["b.x"][-1] - exact(2)[2]))
        return {"order": math.log2(errors[0] / errors[1])}

    return measure


def spring(gauss_seidel: bool, h: float = 0.1, steps: int = 20) -> dict[str, np.ndarray]:
    """Return x and force of x'' = F with F = −9 x of the end (or the start) of the step before."""
    x, v, force, rows = 1.0, 0.0, -9.0, [(1.0, -9.0)]
    for _ in range(steps):
        start, (x, v) = x, (x + h * v + h * h / 2 * force, v + h * force)
        force = -9 * (x if gauss_seidel else start)
        rows.append((x, force))
    return dict(zip(("a.x", "b.F"), np.array(rows).T, strict=True))


FREE = Model("free", (u("F"), V("x", start=1.0), V("v", "local", start=0.0)), {"x": "v", "v": "F"}, depends={})
SPRING = Model("spring", (u("x"), V("F")), {}, "F = -9 * x;", depends={"F": ("x",)})
GAIN = Model("gain", (u(), V("y"), p("k", 1.0), p("c", 0.0)), {}, "y = k * u + c;", depends={"y": ("u",)})
UNDECLARED_GAIN = Model("gain", GAIN.variables, {}, GAIN.calc)
STEP = {"u": {"start": 0, "changes": [{"at": 0.5, "to": 1}]}}
CHAIN = {f"g{k}": {"k": 2} for k in (3, 2, 1)}  # in the file from the last to the first


def chain(algorithm: str) -> Callable[[Path], Any]:
    return runs(
        lambda _: scenario(
            {name: part(GAIN, start=start) for name, start in CHAIN.items()}
            | {"r": {"block": "reference", "signals": STEP}},
            ["g2.y > g3.u", "g1.y > g2.u", "r.u > g1.u"],
            1,
            algorithm=algorithm,
        )
    )


def pulse(delay: int) -> np.ndarray:
    """Return 0 and from row 5 + delay on 1."""
    return (np.arange(11) >= 5 + delay).astype(float)


def masses(kind: str = "force") -> dict[str, Any]:
    pair = (MASS, HUNG) if kind == "force" else (LEFT, RIGHT)
    return dict(zip("ab", map(part, pair), strict=True))


COUPLING = [
    Case(
        "spring-gauss-seidel", "coupling", "x'' = F and F = −9 x in two FMUs, h = 0.1 s, Gauss-Seidel.",
        "x_k+1 = x_k + h v_k + h²/2 F_k, v_k+1 = v_k + h F_k, F_k+1 = −9 x_k+1: the spring steps after the mass",
        {"": runs(lambda _: scenario({"b": part(SPRING), "a": part(FREE)}, ["a.x > b.x", "b.F > a.F"]))},
        columns(spring(True)),
    ),
    Case(
        "spring-jacobi", "coupling", "The same by Jacobi.",
        "F_k+1 = −9 x_k: each FMU has the values of the step's start",
        {"": runs(lambda _: scenario({"b": part(SPRING), "a": part(FREE)}, ["a.x > b.x", "b.F > a.F"],
            algorithm="jacobi"))},
        columns(spring(False)),
    ),
    Case(
        "two-masses-gauss-seidel", "coupling",
        "Two masses, coupled by force and displacement, h = 0.05 s, Gauss-Seidel.",
        "the recurrence by matrix exponentials, the second FMU after the first",
        {"": runs(lambda _: scenario(masses(), FORCE, 2, 0.05)),
         "model exchange": runs(lambda _: scenario(
             {"a": part(MASS, 2, "me"), "b": part(HUNG, 3, "me")}, FORCE, 2, 0.05, tolerance=1e-11))},
        columns(two_masses(True, 0.05, 40), 1e-7), because="model exchange: CVODE at 1e-11 a step",
    ),
    Case(
        "two-masses-jacobi", "coupling", "The same by Jacobi.", "the recurrence, both with values of the step's start",
        {"": runs(lambda _: scenario(masses(), FORCE, 2, 0.05, algorithm="jacobi")),
         "own process": runs(lambda _: scenario(
             {k: v | {"process": "own"} for k, v in masses().items()}, FORCE, 2, 0.05, algorithm="jacobi"))},
        columns(two_masses(False, 0.05, 40)),
    ),
    Case(
        "held-order", "coupling", "Two masses, coupled by displacements, held inputs.",
        "the error against both masses in one system (matrix exponential) is of order 1",
        {"": order_of("displacement")}, [Answer("order", None, 1.0, 0.2)],
        because="terms of higher order at 0.02 and 0.01 s",
    ),
    Case(
        "linear-order", "coupling", "The same with `extrapolate: linear`.", "order 2",
        {"": order_of("displacement", extrapolate="linear")}, [Answer("order", None, 2.0, 0.3)],
        because="terms of higher order at 0.02 and 0.01 s",
    ),
    Case(
        "quadratic-order", "coupling", "The same with `extrapolate: quadratic`.", "order 3, as coupling.md says",
        {"": order_of("displacement", extrapolate="quadratic")},
        [Answer("order", None, 3.0, 0.4)], because="terms of higher order at 0.02 and 0.01 s",
        later="courses of inputs have another order (a later issue)",
    ),
    Case(
        "jacobi-linear-order", "coupling", "Two masses, coupled by force, `jacobi`, `extrapolate: linear`.",
        "order 2, as coupling.md says",
        {"": order_of("force", algorithm="jacobi", extrapolate="linear")}, [Answer("order", None, 2.0, 0.3)],
        because="terms of higher order at 0.02 and 0.01 s",
        later="courses of inputs have another order (a later issue)",
    ),
    Case(
        "gauss-seidel-linear-order", "coupling", "Two masses, coupled by force, Gauss-Seidel, both courses linear.",
        "order 2, as coupling.md says",
        {"": order_of("force", extrapolate="linear", interpolate="linear")}, [Answer("order", None, 2.0, 0.3)],
        because="terms of higher order at 0.02 and 0.01 s",
    ),
    Case(
        "chain-gauss-seidel", "coupling",
        "Three gains of 2 in a row, written from the last to the first; a step at 0.5 s.",
        "8 from 0.5 s on: a chain of direct feedthrough has no delay", {"": chain("gauss-seidel")},
        columns({f"g{n}.y": 2**n * pulse(0) for n in (1, 2, 3)}),
    ),
    Case(
        "chain-jacobi", "coupling", "The same by Jacobi.",
        "2 from 0.5 s, 4 from 0.6 s, 8 from 0.7 s on: the source has no delay; FMUs see each other's last row",
        {"": chain("jacobi")}, columns({f"g{n}.y": 2**n * pulse(n - 1) for n in (1, 2, 3)}),
    ),
    Case(
        "factor-and-offset", "coupling", "y = 3 through a connection with factor 2 and offset −1.", "u = 2 · 3 − 1 = 5",
        {algorithm: runs(lambda _, algorithm=algorithm: scenario(
            {"a": part(GAIN, start={"c": 3}), "b": part(GAIN)},
            [{"from": "a.y", "to": "b.u", "factor": 2, "offset": -1}],
            0.2, algorithm=algorithm)) for algorithm in ("gauss-seidel", "jacobi")},
        [*at(0.0, b_u=5.0, b_y=5.0), *at(0.2, b_u=5.0, b_y=5.0)],
    ),
    Case(
        "freeze-and-scale", "coupling",
        "x = t through connections with `scale` of 3 from 1 s, and `freeze` from 0.5 to 1 s.",
        "3 t from 1 s on; 0.4 from 0.5 to 1 s: the last value before the fault",
        {"": runs(lambda _: scenario(
            {"i": part(PLAIN, start={"u": 1}), "s": part(GAIN), "f": part(GAIN)}, ["i.x > s.u", "i.x > f.u"], 2, 0.1,
            faults=[{"on": "s.u", "kind": "scale", "from": 1, "value": 3},
                    {"on": "f.u", "kind": "freeze", "from": 0.5, "to": 1}]))},
        [*at(0.9, s_u=0.9), *at(1.0, s_u=3.0, f_u=0.4), *at(0.5, f_u=0.4), *at(1.1, f_u=1.1)],
    ),
]  # fmt: skip

# -- several rates -----------------------------------------------------------------------------------

FAST = Model("fast", (u(), V("x", start=1.0)), {"x": "-x + u"}, depends={})
SLOW = Model("slow", (u("w"), V("z", start=0.0)), {"z": "-2 * z + w"}, depends={})
SLOW_DIRECT = Model(
    "slow", (u("w"), V("z", start=0.0), V("y")), {"z": "-2 * z + w"}, "y = z + w;", depends={"z": (), "y": ("w",)}
)
COUNTER = Model(
    "counter",
    (V("n", type="Int32", start=0), V("seen", start=0.0, variability="discrete")),
    {},
    step="n += 1; seen = t + h;",
    depends={},
    any_step=False,
)


def rates(direct: bool) -> dict[str, np.ndarray]:
    """Return rows of the fast FMU (0.1 s) and of the slow one (0.5 s)."""
    f, s = math.exp(-0.1), math.exp(-1)
    x, z = 1.0, 0.0
    w = x
    y = z + w if direct else z
    rows = [(x, z)]
    for k in range(20):
        x = f * x + (1 - f) * y
        if k % 5 == 4:
            w = x if direct else w
            z = s * z + (1 - s) / 2 * w
            y = z + w if direct else z
            w = x
        rows.append((x, z))
    return dict(zip(("a.x", "b.z"), np.array(rows).T, strict=True))


MULTI_RATE = [
    Case(
        "slow-without-feedthrough", "multi-rate", "x' = −x + z each 0.1 s, z' = −2 z + x with `step: 0.5`.",
        "the recurrence: the slow step is made at its end from the input at its start; until then z is constant",
        {"": runs(lambda _: scenario({"a": part(FAST), "b": part(SLOW, step=0.5)}, ["b.z > a.u", "a.x > b.w"])),
         "model exchange": runs(lambda _: scenario(
             {"a": part(FAST, 2, "me"), "b": part(SLOW, 2, "me", step=0.5)}, ["b.z > a.u", "a.x > b.w"],
             tolerance=1e-10))},
        columns(rates(False), 1e-8), because="model exchange: CVODE at 1e-10 a step",
    ),
    Case(
        "slow-without-feedthrough-1", "multi-rate",
        "The same, with a fast FMU of FMI 1.0 that declares no DirectDependency.",
        "the same: an empty DirectDependency is no feedthrough (FMI 1.0)",
        {"": runs(lambda _: scenario({"a": part(FAST, 1), "b": part(SLOW, step=0.5)}, ["b.z > a.u", "a.x > b.w"]))},
        columns(rates(False)),
    ),
    Case(
        "slow-with-feedthrough", "multi-rate", "The same, with y = z + x of the slow FMU as input of the fast one.",
        "the slow step is made from the input at its end", {"": runs(lambda _: scenario(
            {"a": part(FAST), "b": part(SLOW_DIRECT, step=0.5)}, ["b.y > a.u", "a.x > b.w"]))},
        columns(rates(True)),
    ),
    Case(
        "sampled-counter", "multi-rate", "An FMU that counts its steps, `step: 0.25`, beside steps of 0.05 s.",
        "n = ⌊t / 0.25⌋, and the time that it has seen is 0.25 n",
        {"": runs(lambda _: scenario({"c": part(COUNTER, step=0.25), "i": part(PLAIN)}, (), 1, 0.05))},
        columns({"c.n": np.floor(np.arange(21) / 5 + 1e-9), "c.seen": 0.25 * np.floor(np.arange(21) / 5 + 1e-9)}),
    ),
    Case(
        "sampled-sensor", "multi-rate", "A `fix` of x = t at 2 Hz with a latency of 0.1 s.",
        "the sample of 0.5 s appears at 0.6 s and holds until 1.1 s",
        {"": runs(lambda _: scenario(
            {"i": part(PLAIN, start={"u": 1}), "s": {"block": "fix", "rate": 2, "latency": 0.1, "signals": {"x": {}}},
             "g": part(GAIN)},
            ["i.x > s.x", "s.x_meas > g.u"], 2, 0.1))},
        [*at(0.5, g_u=0.0), *at(0.6, g_u=0.5), *at(1.0, g_u=0.5), *at(1.1, g_u=1.0)],
    ),
    Case(
        "recorded-part", "multi-rate", "x = t with steps of 0.01 s and `record: {every: 0.5}`.",
        "rows at 0, 0.5, 1, 1.2 s",
        {"": runs(lambda _: scenario({"i": part(PLAIN, start={"u": 1})}, (), 1.2, 0.01,
                                     record={"every": 0.5, "signals": ["i.x"]}))},
        columns({"i.x": np.array([0, 0.5, 1, 1.2])}),
    ),
]  # fmt: skip

# -- controlled steps and solvers ---------------------------------------------------------------------

VDP = Model(
    "vdp", (V("x", start=2.0), V("y", start=0.0), p("mu", 1.0)), {"x": "y", "y": "mu * (1 - x * x) * y - x"}, depends={}
)
ROBERTSON = Model(
    "rober",
    (V("x", start=1.0), V("y", start=0.0), V("z", start=0.0)),
    {"x": "-0.04 * x + 1e4 * y * z", "y": "0.04 * x - 1e4 * y * z - 3e7 * y * y", "z": "3e7 * y * y"},
    depends={},
)
PREY = Model(
    "prey",
    (V("x", start=20.0), V("y", start=20.0)),
    {"x": "0.1 * x - 0.02 * x * y", "y": "0.02 * x * y - 0.4 * y"},
    depends={},
)
DRIVEN = Model("driven", (V("x", start=0.0),), {"x": "cos(time)"}, depends={})


@cache
def integrated(name: str, end: float, method: str = "DOP853") -> np.ndarray:
    """Return the states at the end by another integrator at 1e-12."""
    laws: dict[str, tuple[Callable[[float, Any], list[float]], list[float]]] = {
        "vdp": (lambda t, s: [s[1], (1 - s[0] ** 2) * s[1] - s[0]], [2, 0]),
        "prey": (lambda t, s: [0.1 * s[0] - 0.02 * s[0] * s[1], 0.02 * s[0] * s[1] - 0.4 * s[1]], [20, 20]),
        "rober": (lambda t, s: [-0.04 * s[0] + 1e4 * s[1] * s[2], 0.04 * s[0] - 1e4 * s[1] * s[2] - 3e7 * s[1] ** 2,
                                3e7 * s[1] ** 2], [1, 0, 0]),
    }  # fmt: skip
    law, start = laws[name]
    return np.asarray(solve_ivp(law, (0, end), start, method=method, rtol=1e-12, atol=1e-14).y[:, -1])


def solved(
    model: Model, end: float, step: float, tolerance: float = 1e-10, **keys: Any
) -> dict[str, Callable[[Path], Any]]:
    """Return the runs of model exchange by both solvers."""
    return {
        solver: runs(
            lambda _, solver=solver: scenario(
                {"m": part(model, 2, "me", solver=solver, **keys)}, (), end, step, tolerance=tolerance
            )
        )
        for solver in ("cvode", "solve_ivp")
    }


def peer_of(model: Model, end: float, step: float, tolerance: float = 1e-10) -> Peer:
    arguments = {"stop_time": end, "output_interval": step, "relative_tolerance": tolerance}
    return Peer(lambda: model.fmu(2, "me"), arguments)


def controlled(kind: str = "force", **step: Any) -> Callable[[Path], Any]:
    wires = FORCE if kind == "force" else DISPLACEMENT
    return runs(lambda _: scenario(masses(kind), wires, 2, {"max": 0.1, "min": 1e-5, **step}))


CONTROL = [
    Case(
        "controlled-steps", "step control",
        "Two masses, steps controlled by `halving` and `residual` at 1e-6 and 1e-4.",
        "both masses in one system, by the matrix exponential, at rows of 0.1 s",
        {"halving": controlled("displacement", tolerance=1e-6, estimator="halving"),
         "residual": controlled("displacement", tolerance=1e-4, estimator="residual")},
        [*(Answer("a.x", t, exact(t)[0], 1e-4) for t in (0.5, 1.0, 1.5, 2.0)), Answer("b.x", 2.0, exact(2)[2], 1e-4)],
        because="errors of some hundred steps at the tolerance add up",
    ),
    Case(
        "energy-steps", "step control",
        "Two masses, coupled by force and velocity, steps controlled by `energy` at 1e-4.",
        "as above",
        {"": controlled(tolerance=1e-4, estimator="energy", bonds=[{"effort": "b.F", "flow": "a.v"}])},
        [Answer("a.x", 2.0, exact(2)[0], 2e-3), Answer("b.x", 2.0, exact(2)[2], 2e-3)],
        because="the energy residual does not see errors near zero power (coupling.md)",
    ),
    Case(
        "van-der-pol", "step control", "x'' = (1 − x²) x' − x by model exchange.", "DOP853 of scipy at 1e-12, 10 s",
        solved(VDP, 10, 0.5, 1e-9), [Answer("m.x", 10.0, lambda: integrated("vdp", 10)[0], 2e-6)],
        because="1e-9 a solver step, some 400 steps", peer=peer_of(VDP, 10, 0.5, 1e-9),
    ),
    Case(
        "stiff-van-der-pol", "step control", "The same with μ = 1000.",
        "x(2000) = 1.706167732170483 (test set for IVP solvers)",
        {"cvode": solved(VDP, 2000, 100, 1e-9, start={"mu": 1000}, max_steps=100000)["cvode"],
         "solve_ivp": solved(VDP, 2000, 100, 1e-8, start={"mu": 1000})["solve_ivp"]},
        [Answer("m.x", 2000.0, 1.706167732170483, 1e-6)], because="1e-8 a solver step",
    ),
    Case(
        "robertson", "step control", "Robertson's reaction, with rates from 0.04 to 3·10⁷ 1/s, by model exchange.",
        "Radau of scipy at 1e-12, 40 s: x = 0.715827",
        solved(ROBERTSON, 40, 4, 1e-8),
        [Answer("m.x", 40.0, lambda: integrated("rober", 40, "Radau")[0], 1e-6),
         Answer("m.y", 40.0, lambda: integrated("rober", 40, "Radau")[1], 1e-10)],
        because="1e-8 a solver step; y is 9e-6", peer=peer_of(ROBERTSON, 40, 4, 1e-8),
    ),
    Case(
        "prey-and-predators", "step control", "Lotka's and Volterra's equations over one and a half periods.",
        "DOP853 of scipy at 1e-12, 30 s",
        solved(PREY, 30, 1, 1e-9), [Answer("m.x", 30.0, lambda: integrated("prey", 30)[0], 1e-5),
                              Answer("m.y", 30.0, lambda: integrated("prey", 30)[1], 1e-5)],
        because="1e-9 a solver step, relative to 20", peer=peer_of(PREY, 30, 1, 1e-9),
    ),
    Case(
        "rate-of-time", "step control", "x' = cos t by model exchange, and by co-simulation.", "x = sin t",
        solved(DRIVEN, 10, 0.5) | {"cs": runs(lambda _: scenario({"m": part(DRIVEN)}, (), 10, 0.5))},
        [Answer("m.x", None, np.sin(np.arange(21) * 0.5), 1e-7)], because="1e-10 a solver step",
        peer=peer_of(DRIVEN, 10, 0.5),
    ),
]  # fmt: skip

# -- algebraic loops -----------------------------------------------------------------------------------


def loop(first: dict[str, Any], second: dict[str, Any], model: Model = GAIN, **keys: Any) -> Callable[[Path], Any]:
    """Return the run of two FMUs that need each other's output."""
    way = keys.pop("way", "cs")
    other = keys.pop("other", GAIN)
    return runs(
        lambda _: scenario(
            {"a": part(model, 2, way, start=first), "b": part(other, 2, way, start=second)},
            ["a.y > b.u", "b.y > a.u"],
            1,
            0.1,
            **keys,
        )
    )


def constant(**values: float) -> list[Answer]:
    return [*at(0.0, 1e-7, **values), *at(1.0, 1e-7, **values)]


LINEAR = {"first": {"k": 0.5, "c": 1}, "second": {"k": 0.5}}
STEEP = {"first": {"k": 3, "c": 1}, "second": {"k": 1}}
FOLLOWS = Model(
    "initloop",
    (u(), V("y"), p("k", 1.0), p("c", 0.0), V("s", "local", start=0.0, variability="discrete")),
    {},
    "if (initializing) s = k * u + c; y = s;",
    "s = k * u + c;",
    "s -= h * s;",
)
FOLLOWS_DECLARED = Model(
    "initloop",
    FOLLOWS.variables,
    {},
    FOLLOWS.calc,
    FOLLOWS.start,
    FOLLOWS.step,
    depends={},
    initial={"y": ("u", "k", "c")},
)
SQUARE = Model("square", GAIN.variables, {}, "y = k * u * u + c;", depends=GAIN.depends)
EXPONENTIAL = Model("expo", GAIN.variables, {}, "y = k * exp(-u) + c;", depends=GAIN.depends)
COSINE = Model("cosine", GAIN.variables, {}, "y = k * cos(u) + c;", depends=GAIN.depends)
FILTER = Model(
    "filter", (u(), V("x", start=1.0), V("y")), {"x": "-x + u"}, "y = x + 0.5 * u;", depends={"x": (), "y": ("u",)}
)
PAIR = Model(
    "pair",
    (u("u1"), u("u2"), V("y"), p("k1", 0.0), p("k2", 0.0), p("c", 0.0)),
    {},
    "y = k1 * u1 + k2 * u2 + c;",
    depends={"y": ("u1", "u2")},
)
MATRIX = np.array([[0, 0.3, -0.7], [2.0, 0, 0.4], [-0.5, 1.5, 0]])
RIGHT_SIDE = np.array([1.0, -2.0, 0.5])
SOLUTION = np.linalg.solve(np.eye(3) - MATRIX, RIGHT_SIDE)
SUM = Model("sum", (u(), u("r"), V("y")), {}, "y = 0.5 * u + r;", depends={"y": ("u", "r")})


def three(**keys: Any) -> Callable[[Path], Any]:
    """Return the run of y = M y + c in three FMUs."""
    others = {0: (1, 2), 1: (0, 2), 2: (0, 1)}
    wires = [f"f{n}.y > f{k}.u{place + 1}" for k, pair in others.items() for place, n in enumerate(pair)]
    starts = {f"f{k}": {"k1": MATRIX[k, i], "k2": MATRIX[k, j], "c": RIGHT_SIDE[k]} for k, (i, j) in others.items()}
    return runs(
        lambda _: scenario({name: part(PAIR, start=start) for name, start in starts.items()}, wires, 0.5, **keys)
    )


def opened() -> dict[str, np.ndarray]:
    """Return rows of a = b/2 + 1 with b of the row before, b = a/2 + r; r is 1 from 0.5 s on."""
    a, b, rows = 4 / 3, 2 / 3, [(4 / 3, 2 / 3)]
    for k in range(1, 11):
        a = b / 2 + 1
        b = a / 2 + (k >= 5)
        rows.append((a, b))
    return dict(zip(("a.y", "b.y"), np.array(rows).T, strict=True))


def fails(run: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """Return the exit code of a run."""

    def code(folder: Path) -> dict[str, int]:
        try:
            run(folder)
        except SimulationError as error:
            return {"exit code": error.exit_code}
        return {"exit code": 0}

    return code


LOOPS = [
    Case(
        "linear-loop", "loop", "a = b/2 + 1, b = a/2 in two FMUs.", "a = 4/3, b = 2/3",
        {"declared": loop(**LINEAR), "undeclared": loop(**LINEAR, model=UNDECLARED_GAIN, other=UNDECLARED_GAIN),
         "anderson": loop(**LINEAR, loops={"method": "anderson"}), "model exchange": loop(**LINEAR, way="me")},
        constant(a_y=4 / 3, b_y=2 / 3),
    ),
    Case(
        "steep-loop", "loop", "a = 3 b + 1, b = a: a loop gain of 3.", "a = −0.5: loops are solved, not iterated",
        {"declared": loop(**STEEP), "undeclared": loop(**STEEP, model=UNDECLARED_GAIN, other=UNDECLARED_GAIN),
         "model exchange": loop(**STEEP, way="me")},
        constant(a_y=-0.5, b_y=-0.5),
    ),
    Case(
        "three-in-a-loop", "loop", "y = M y + c in three FMUs, with a loop gain above 1.", "(I − M)⁻¹ c by numpy",
        {"newton": three(), "anderson": three(loops={"method": "anderson"})},
        [Answer(f"f{k}.y", 0.5, value, 1e-7) for k, value in enumerate(SOLUTION)],
    ),
    Case(
        "loop-at-initialization", "loop",
        "y = k u + c in initialization, later y decays by 10 % a step; a: k = 3, c = 1; b: k = 1.",
        "a(0) = −0.5, a(1) = −0.5 · 0.9¹⁰",
        {"undeclared": loop(**STEEP, model=FOLLOWS, other=FOLLOWS),
         "undeclared, loops": loop(**STEEP, model=FOLLOWS, other=FOLLOWS, loops={}),
         "declared": loop(**STEEP, model=FOLLOWS_DECLARED, other=FOLLOWS_DECLARED),
         "declared, loops": loop(**STEEP, model=FOLLOWS_DECLARED, other=FOLLOWS_DECLARED, loops={})},
        [*at(0.0, 1e-7, a_y=-0.5, b_y=-0.5), *at(1.0, 1e-7, a_y=-0.5 * 0.9**10)],
        because="tolerance 1e-8 of a loop",
    ),
    Case(
        "double-root", "loop", "a = b² + 1/4, b = a.", "a = 1/2, a double root",
        {"": loop({"k": 1, "c": 0.25}, {"k": 1}, SQUARE)}, [*at(0.0, 1e-3, a_y=0.5), *at(1.0, 1e-3, a_y=0.5)],
        because="a residual of 1e-8 belongs to an error of 1e-4 at a double root",
    ),
    Case(
        "omega-constant", "loop", "a = exp(−b), b = a.", "0.5671432904097838 (DLMF 4.13)",
        {"": loop({"k": 1}, {"k": 1}, EXPONENTIAL), "model exchange": loop({"k": 1}, {"k": 1}, EXPONENTIAL, way="me")},
        constant(a_y=0.5671432904097838),
        because="tolerance 1e-8 of a loop",
    ),
    Case(
        "cosine-of-itself", "loop", "a = cos b, b = a.", "0.7390851332151607",
        {"": loop({"k": 1}, {"k": 1}, COSINE)}, constant(a_y=0.7390851332151607), because="tolerance 1e-8 of a loop",
    ),
    Case(
        "loop-with-a-state", "loop", "x' = −x + u, y = x + u/2 and u = y/2 in two FMUs, h = 0.1 s.",
        "u = 2 x/3, so x_k = (e^−h + (1 − e^−h)·2/3)^k: the input of a step is that of its start",
        {way: loop({}, {"k": 0.5}, FILTER, way=way, tolerance=1e-11) for way in ("cs", "me")},
        columns({"a.x": (math.exp(-0.1) + (1 - math.exp(-0.1)) * 2 / 3) ** np.arange(11.0)}, 1e-7),
        because="tolerance 1e-8 of a loop",
    ),
    Case(
        "loop-gain-1", "loop", "a = b + 1, b = a: no solution.", "exit code 4",
        {"": fails(loop({"k": 1, "c": 1}, {"k": 1}))}, [Answer("exit code", None, 4, 0)],
    ),
    Case(
        "open-loop", "loop", "a = b/2 + 1, b = a/2 + r with `order: [a, b]`; r is 1 from 0.5 s on.",
        "a_k = b_k−1 / 2 + 1, b_k = a_k / 2 + r_k",
        {"": runs(lambda _: scenario(
            {"a": part(GAIN, start={"k": 0.5, "c": 1}), "b": part(SUM), "r": {"block": "reference", "signals": STEP}},
            ["b.y > a.u", "a.y > b.u", "r.u > b.r"], 1, 0.1, order=["a", "b"]))},
        columns(opened(), 1e-9),
    ),
]  # fmt: skip
CASES = [*COUPLING, *MULTI_RATE, *CONTROL, *LOOPS]
