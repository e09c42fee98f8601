"""SSPs, and verbs that compute something of a run or of a log."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.couplings import BY_FORCE, GAIN, LEFT
from tests.known.interfaces import DECAY, NEGATED
from tests.known.kit import Model, Way, tag
from tests.known.sources import DIRECT, EPOCH, INTEGRATORS
from tests.known.table import Case, Run, at, found, part, run, table
from tests.known.values import METRIC_HP, OWN_HP, through
from tests.lag import bound, component, connection, real, ssp
from tests.warm import cosim as command


def system(elements: str, connections: str = "", bindings: str = "", name: str = "root", ends: str = "") -> str:
    before = ends + (tag("ssd:ParameterBindings", bindings) if bindings else "")
    return tag("ssd:System", before, tag("ssd:Elements", elements), tag("ssd:Connections", connections), name=name)


def inside(**values: float) -> str:
    """Return the sets of parameters of a component."""
    return tag("ssd:ParameterBindings", bound({name: real(value) for name, value in values.items()}))


def linear(factor: float, offset: float) -> str:
    return tag("ssc:LinearTransformation", factor=factor, offset=offset)


def packed(content: str, **fmus: Model) -> Callable[[Path], Any]:
    """Return the run of an SSP of a system and its FMUs."""

    def ran(folder: Path) -> Any:
        files = {f"resources/{name}.fmu": model.fmu() for name, model in (fmus or {"gain": GAIN}).items()}
        path = ssp(folder / "s.ssp", content, files, '<ssd:DefaultExperiment startTime="0" stopTime="1"/>')
        return cosim.run(path, set={"step": 0.1})

    return ran


A, B = component("a", "gain.fmu"), component("b", "gain.fmu")
ENDS = tag("ssd:Connectors", *(tag("ssd:Connector", tag("ssc:Real"), name=n, kind=k)
                               for n, k in (("u", "input"), ("y", "output"))))  # fmt: skip
INNER = system(component("g", "gain.fmu"), connection("u", "g.u") + connection("g.y", "y"), "", "inner", ENDS)
MIDDLE = system(
    INNER, connection("u", "inner.u") + connection("inner.y", "y", linear(10, 1)), "", "middle", ENDS
)  # fmt: skip
MAPPING = tag(
    "ssd:ParameterMapping",
    tag(
        "ssm:ParameterMapping",
        tag("ssm:MappingEntry", linear(0.5, 1), source="p", target="a.c"),
        tag("ssm:MappingEntry", source="p", target="a.k"),
        version="1.0",
    ),
)
FIVE = bound({"a.c": real(5)})
COLD = component("b", "cold.fmu", units=("K", "K"))
DEGREES = tag("ssv:Units", tag("ssc:Unit", tag("ssc:BaseUnit", K=1, offset=273.15), name="degC"))


def temperatures(**attributes: str) -> Callable[[Path], Any]:
    warm = component("a", "warm.fmu", inside(u=20), ("degC", "degC"))
    connected = system(warm + COLD, connection("a.y", "b.u", **attributes))
    return packed(connected, warm=through("degC"), cold=through("K"))


def exported(content: Any, folder: Path) -> Any:
    """Return the largest difference of an SSP that cosim writes of a scenario."""
    (folder / "s.json").write_text(json.dumps(content))
    cosim.export_ssp(folder / "s.json", folder / "s.ssp")
    here, there = cosim.run(content), cosim.run(folder / "s.ssp")
    return {"largest difference": max(np.abs(here[n] - there[n]).max() for n in ("a.x", "b.x", "b.F"))}


SSP = [
    Case(
        "nested-systems", "A gain of 3 in two systems within each other, the outer one with 10·y + 1; u = 5.",
        "y(1) = 10 · 3 · 5 + 1 = 151, at the component behind",
        packed(system(A + B + MIDDLE, connection("a.y", "middle.u") + connection("middle.y", "b.u"),
                      bound({"a.c": real(5), "middle.inner.g.k": real(3)}))),
        at(1.0, b_u=151.0),
    ),
    Case(
        "parameter-sets", "Two sets for c of a component: 1 and then 2; 5 of its system, with a prefix.",
        "5: an outer set has priority (SSP 1.0, 4.5.2); k = 2, of the last inner set",
        packed(system(component("a", "gain.fmu", tag("ssd:ParameterBindings", bound({"c": real(1), "k": real(4)}),
                                                     bound({"c": real(2), "k": real(2)}))), "",
                      bound({"c": real(5), "u": real(10)}, prefix="a."))),
        at(1.0, a_y=2 * 10.0 + 5),
    ),
    Case(
        "parameter-mapping", "p = 4, mapped to k as it is and to c by 0.5·p + 1.", "c = 3",
        packed(system(component("a", "gain.fmu", inside(u=10)), "", bound({"p": real(4)}, MAPPING))),
        at(1.0, a_y=4 * 10.0 + 3),
    ),
    Case(
        "connection-transformation", "y = 5 through a LinearTransformation with factor 2 and offset 1.", "u = 11",
        packed(system(A + B, connection("a.y", "b.u", linear(2, 1)), FIVE)), at(1.0, b_u=11.0, b_y=11.0),
    ),
    Case(
        "reversed-connection", "The same, written from the input to the output.",
        "u = 11: it acts from source to destination (SSP 1.0: the ends do not denote the direction)",
        packed(system(A + B, connection("b.u", "a.y", linear(2, 1)), FIVE)), at(1.0, b_u=11.0, b_y=11.0),
    ),
    Case(
        "parameter-units", "A parameter of 20 degC for an input in K, in a set that defines the unit.", "293.15 K",
        packed(system(COLD, "", bound({"b.u": real(20, "degC")}).replace("</ssv:ParameterSet>",
                                                                         f"{DEGREES}</ssv:ParameterSet>")),
               cold=through("K")),
        at(1.0, b_y=293.15),
    ),
    Case("connector-units", "20 degC to a connector in K.", "293.15 K", temperatures(), at(1.0, b_y=293.15)),
    Case(
        "suppressed-conversion", "The same with `suppressUnitConversion`.", "20",
        temperatures(suppressUnitConversion="true"), at(1.0, b_y=20.0),
    ),
    Case(
        "horse-powers-ssp", "100 hp of 735.49875 W into an FMU whose hp has 745.699872 W.",
        "98.6319…: units of FMUs belong to their file",
        packed(system(component("a", "metric.fmu", inside(u=100)) + component("b", "mechanical.fmu"),
                      connection("a.y", "b.u")),
               metric=through("hp", METRIC_HP), mechanical=through("hp")),
        at(1.0, b_y=100 * OWN_HP),
    ),
    Case(
        "exported", "Two masses by Jacobi, written by `export-ssp` and run.",
        "the numbers of the scenario, to the bit", run(*BY_FORCE, 1, 0.1, exported, algorithm="jacobi"),
        found({"largest difference": 0.0}, 0),
    ),
]  # fmt: skip

# -- verbs -------------------------------------------------------------------------------------------------

TOGGLE = Model(
    "Boolean on = false, Int32 n = 0, x = 0",
    "x' = 1",
    "n = (int)floor(time / 0.2 + 1e-9); on = n % 2;",
)
TWICE = Model("input u = 0, y", "", "y = 2 * u;", DIRECT)
SECOND_ORDER = Model("input r = 1, x = 0, local v = 0", "x' = v, v' = r - x - 0.4 * v")
TIMES = np.arange(81) * 0.05


def compared(*runs: Run) -> Callable[[Path], Any]:
    """Return how far two runs differ, and where."""

    def compare(folder: Path) -> Any:
        for number, one in enumerate(runs):
            cosim.run(one.written(folder), folder / str(number), report=False)
        made: Any = cosim.compare(folder / "0", folder / "1", folder / "c", tolerance=0.01)
        places = {f"{d.name} at": d.at for d in made.differences}
        return {"beyond": len(made.beyond)} | {d.name: d.largest for d in made.differences} | places

    return compare


def units_compared(folder: Path) -> Any:
    first = table(folder / "a.csv", "time,w [rpm],v [km/h],s [m]", (0, 60, 36, 1), (1, 60, 36, 1))
    second = table(folder / "b.csv", "time,w [rad/s],v [m/s],s [m]", *((t, 2 * math.pi, 10, 1.5) for t in (0, 1)))
    made: Any = cosim.compare(first, second, folder / "c")
    return {d.name: d.largest for d in made.differences}


def commanded(folder: Path) -> Any:
    """Return x and the exit codes of commands."""
    decay, gain, out = {"m": part(DECAY)}, part(GAIN, start={"c": 1}), ("--out", "o", "--no-report", "--force")
    words = ("--set", "k=2", "--stop", "1", "--step", "0.1", *out)
    codes = [command("simulate", DECAY.fmu(), *words, cwd=folder).returncode]
    first: Any = cosim.read(folder / "o")["m.x"][-1]  # type: ignore[index]
    for one in (
        run(decay, criteria={"peak": {"of": "m.x", "max": 0.5}}),
        run({"a": gain, "b": part(GAIN)}, "a.y > b.u, b.y > a.u"),
        run(decay, unknown=1),
    ):
        (folder / "s.json").write_text(json.dumps(one.written(folder)))
        codes.append(command("run", "s.json", *out, cwd=folder).returncode)
    return {"x": first, "codes": codes}


def replayed(
    model: Model, columns: Mapping[str, np.ndarray], way: Way = "cs", begin: float = 0, **start: float
) -> Callable[[Path], Any]:
    """Return least and largest residuals of a log of columns."""

    def replay(folder: Path) -> Any:
        rows = zip((begin + TIMES).round(9), *columns.values(), strict=True)
        log = table(folder / "log.csv", ",".join(["time", *columns]), *rows)
        residual = cosim.replay(log, fmu=model.fmu(2, way), start=start).residual
        assert residual is not None
        kept = {name: residual[f"free_run.{name}"] for name in columns if f"free_run.{name}" in residual}
        return {f"{word} {name}": of(v) for name, v in kept.items() for word, of in (("least", min), ("most", max))}

    return replay


def linearized(model: Model, version: int = 2) -> Callable[[Path], Any]:
    """Return the linearization by model exchange."""

    def found(_: Path) -> dict[str, Any]:
        made = cosim.linearize(model.fmu(version, "me")).first
        return {"A": made.A, "B": made.B, "C": made.C, "D": made.D, "frequency": abs(np.linalg.eigvals(made.A)[0])}

    return found


def fitted(folder: Path) -> Any:
    log = table(folder / "log.csv", "time,x", *zip(TIMES.round(9), np.exp(-0.7 * TIMES), strict=True))
    return {"k": cosim.fit([log], DECAY.fmu(), vary=["k"]).values["k"]}


def judged(content: Any, _: Path) -> Any:
    return {c["kind"]: c["value"] for c in cosim.run(content).criteria}


OF_X = {"of": "m.x", "max": 9}
AFTER = np.maximum(0, TIMES - 1)
COMMAND = (TIMES > 0.975).astype(float)
SINE = np.sin(3 * TIMES)
VERB = [
    Case(
        "compare-held",
        "One FMU with rows each 0.1 s and each 0.2 s: a Boolean and an integer that change each 0.2 s, x = t.",
        "no difference in either direction: discrete values hold between rows",
        {name: compared(*(run({"m": part(TOGGLE)}, "", 1.2, step) for step in steps))
         for name, steps in (("a, b", (0.1, 0.2)), ("b, a", (0.2, 0.1)))},
        found({"beyond": 0, "m.on": 0.0, "m.n": 0.0}, 0) + found({"m.x": 0.0}),
    ),
    Case(
        "compare-units", "60 rpm and 36 km/h in one file, 2π rad/s and 10 m/s in the other; 1 m and 1.5 m.",
        "no difference; 0.5 m", units_compared, found({"w": 0.0, "v": 0.0, "s": 0.5}),
    ),
    Case(
        "command-line", "`cosim simulate` of x' = −k x with `--set k=2`; a criterion that is missed; loop gain 1.",
        "x(1) = e^−2 and exit code 0; 5; 4; 2 for an unknown key", commanded,
        found({"x": math.exp(-2)}) + found({"codes": [0, 5, 4, 2]}, 0),
    ),
    Case(
        "compare-curves", "e^−t and e^−2t in rows of 0.1 s.",
        "the largest difference is e^−0.7 − e^−1.4 = 0.24999, at 0.7 s",
        compared(*(run({"m": part(DECAY, start={"k": k})}, "", 1) for k in (1, 2))),
        found({"m.x": math.exp(-0.7) - math.exp(-1.4), "m.x at": 0.7}),
    ),
    Case(
        "replay-residual", "A log of y = 2 u + 0.1 and an FMU of y = 2 u.", "measured − model = 0.1 in every row",
        replayed(TWICE, {"u": SINE, "y": 2 * SINE + 0.1}), found({"least y": 0.1, "most y": 0.1}),
    ),
    Case(
        "replay-step", "A log of x' = u, y = x + u with a step of u at 1 s, by formula, and an FMU of them.",
        "no residual: a row's command acts from its time",
        {f"{name}, {way}, {begin}": replayed(
            model, {"u": COMMAND, "x": AFTER, "y": AFTER + COMMAND * (name != "no feedthrough")}, way, begin, x=0)
         for name, model in INTEGRATORS.items() for way, begin in (("cs", 0), ("me", 0), ("cs", EPOCH))},
        # model exchange: CVODE at 1e-5 a step; from an epoch on, times have a spacing of 2.4e-7 s, for 80 rows
        found({f"{word} {name}": 0.0 for word in ("least", "most") for name in ("x", "y")}, 2e-5),
    ),
    Case(
        "linearized-mass", "x'' = −10 x − 0.1 v + 4 (x₂ − x) + 0.2 (v₂ − v).",
        "A = (0 1; −14 −0.3), B = (0 0; 4 0.2), C = 1, D = 0; |λ| = √14", linearized(LEFT),
        found({"A": [[0, 1], [-14, -0.3]], "B": [[0, 0], [4, 0.2]], "C": np.eye(2), "D": np.zeros((2, 2)),
               "frequency": math.sqrt(14)}, 1e-6),  # central differences
    ),
    Case(
        "linearized-negated-alias", "flow_out' = u with the negated alias flow_in.", "A = 0, B = 1, C = (1; −1), D = 0",
        linearized(NEGATED, 1), found({"A": [[0]], "B": [[1]], "C": [[1], [-1]], "D": [[0], [0]]}, 1e-6),
    ),
    Case(
        "fitted-parameter", "A log of e^−0.7t and x' = −k x with k = 1.", "k = 0.7", fitted,
        found({"k": 0.7}, 1e-5),  # the search ends at a relative change of 1e-6
    ),
    Case(
        "criteria-of-a-decay", "Criteria of x = e^−t over 5 s, rows of 1 ms.",
        "settling time ln 20, effort 1 − e^−5, rms √((1 − e^−10)/10), peak 1, final error e^−5",
        run({"m": part(DECAY)}, "", 5, 0.001, judged, criteria={
            "settling_time": OF_X | {"band": 0.05}, "effort": OF_X, "rms_error": OF_X, "peak": OF_X,
            "final_error": OF_X}),
        # by rows of 1 ms
        found({"settling_time": math.log(20), "effort": 1 - math.exp(-5),
               "rms_error": math.sqrt((1 - math.exp(-10)) / 10)}, 1e-3)
        + found({"peak": 1.0, "final_error": math.exp(-5)}),
    ),
    Case(
        "overshoot", "A step of x'' = 1 − x − 0.4 x', damping 0.2.", "exp(−π 0.2/√0.96) = 0.5266",
        run({"m": part(SECOND_ORDER)}, "", 10, 0.001, judged, criteria={"overshoot": OF_X | {"to": 1}}),
        found({"overshoot": math.exp(-math.pi * 0.2 / math.sqrt(0.96))}, 1e-5),
    ),
]  # fmt: skip
