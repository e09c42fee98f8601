"""SSPs, and verbs that compute something of a run or of a log."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.couplings import FORCE, GAIN, HUNG, LEFT, MASS
from tests.known.interfaces import DECAY
from tests.known.kit import Model, V, u
from tests.known.sources import DECLARED
from tests.known.table import Answer, Case, at, part, scenario, table
from tests.known.values import METRIC_HP, through
from tests.warm import cosim as command

NAMES = (
    'xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription" '
    'xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon" '
    'xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" '
    'xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"'
)


def connector(name: str, kind: str, unit: str = "") -> str:
    real = f'<ssc:Real unit="{unit}"/>' if unit else "<ssc:Real/>"
    return f'<ssd:Connector name="{name}" kind="{kind}">{real}</ssd:Connector>'


def component(name: str, fmu: str = "gain", unit: str = "", inside: str = "") -> str:
    ends = connector("u", "input", unit) + connector("y", "output", unit)
    if fmu == "gain":
        ends += connector("k", "parameter") + connector("c", "parameter")
    head = f'<ssd:Component name="{name}" type="application/x-fmu-sharedlibrary" source="resources/{fmu}.fmu">'
    return f"{head}<ssd:Connectors>{ends}</ssd:Connectors>{inside}</ssd:Component>"


def connection(start: str, end: str, inside: str = "", **attributes: str) -> str:
    """Return a connection `a.y` to `b.u`; a name without a dot is a connector of the system."""
    ends = ""
    for way, place in (("start", start), ("end", end)):
        element, _, name = place.rpartition(".")
        ends += (f' {way}Element="{element}"' if element else "") + f' {way}Connector="{name}"'
    more = "".join(f' {k}="{v}"' for k, v in attributes.items())
    return f"<ssd:Connection{ends}{more}>{inside}</ssd:Connection>"


def linear(factor: float, offset: float = 0.0) -> str:
    return f'<ssc:LinearTransformation factor="{factor}" offset="{offset}"/>'


def parameters(values: Mapping[str, float], name: str = "set") -> str:
    inside = "".join(f'<ssv:Parameter name="{k}"><ssv:Real value="{v}"/></ssv:Parameter>' for k, v in values.items())
    head = f'<ssv:ParameterSet {NAMES} version="1.0" name="{name}">'
    return f"{head}<ssv:Parameters>{inside}</ssv:Parameters></ssv:ParameterSet>"


def binding(values: Mapping[str, float], prefix: str = "", mapping: str = "") -> str:
    head = f'<ssd:ParameterBinding prefix="{prefix}">' if prefix else "<ssd:ParameterBinding>"
    mapped = f"<ssd:ParameterMapping>{mapping}</ssd:ParameterMapping>" if mapping else ""
    return f"{head}<ssd:ParameterValues>{parameters(values)}</ssd:ParameterValues>{mapped}</ssd:ParameterBinding>"


def bindings(*texts: str) -> str:
    return f"<ssd:ParameterBindings>{''.join(texts)}</ssd:ParameterBindings>"


def system(name: str, elements: str, connections: str = "", bound: str = "", ends: str = "") -> str:
    return (
        f'<ssd:System name="{name}">{f"<ssd:Connectors>{ends}</ssd:Connectors>" if ends else ""}{bound}'
        f"<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{connections}</ssd:Connections></ssd:System>"
    )


def ssp(root: Callable[[], tuple[str, Mapping[str, Path]]]) -> Callable[[Path], Any]:
    """Return the run of an SSP of a system and its FMUs."""

    def run(folder: Path) -> Any:
        content, fmus = root()
        path = folder / "system.ssp"
        head = f'<ssd:SystemStructureDescription {NAMES} version="1.0" name="known">'
        times = '<ssd:DefaultExperiment startTime="0" stopTime="1"/>'
        with zipfile.ZipFile(path, "w") as archive:
            text = f'<?xml version="1.0" encoding="UTF-8"?>\n{head}{content}{times}</ssd:SystemStructureDescription>'
            archive.writestr("SystemStructure.ssd", text)
            for name, fmu in fmus.items():
                archive.write(fmu, f"resources/{name}.fmu")
        return cosim.run(path, set={"step": 0.1})

    return run


def gains(content: str) -> Callable[[Path], Any]:
    return ssp(lambda: (content, {"gain": GAIN.fmu()}))


AB = component("a") + component("b")
FIVE = bindings(binding({"a.c": 5}))
INNER = system(
    "inner",
    component("g"),
    connection("u", "g.u") + connection("g.y", "y"),
    ends=connector("u", "input") + connector("y", "output"),
)
MIDDLE = system(
    "middle",
    INNER,
    connection("u", "inner.u") + connection("inner.y", "y", linear(10, 1)),
    ends=connector("u", "input") + connector("y", "output"),
)
MAPPING = (
    f'<ssm:ParameterMapping {NAMES} version="1.0"><ssm:MappingEntry source="p" target="a.c">{linear(0.5, 1)}'
    '</ssm:MappingEntry><ssm:MappingEntry source="p" target="a.k"/></ssm:ParameterMapping>'
)


WARM = (
    '<ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="warm"><ssv:Parameters>'
    '<ssv:Parameter name="b.u"><ssv:Real value="20" unit="degC"/></ssv:Parameter></ssv:Parameters><ssv:Units>'
    '<ssc:Unit name="degC"><ssc:BaseUnit K="1" offset="273.15"/></ssc:Unit></ssv:Units></ssv:ParameterSet>'
    "</ssd:ParameterValues></ssd:ParameterBinding>"
)


def temperatures(**attributes: str) -> Callable[[Path], Any]:
    return ssp(
        lambda: (
            system(
                "root",
                component("a", "warm", "degC", bindings(binding({"u": 20}))) + component("b", "cold", "K"),
                connection("a.y", "b.u", **attributes),
            ),
            {"warm": through("degC").fmu(), "cold": through("K").fmu()},
        )
    )


def exported(folder: Path) -> Any:
    """Return the run of an SSP that cosim wrote of a scenario."""
    path = folder / "s.json"
    path.write_text(json.dumps(scenario({"a": part(MASS), "b": part(HUNG)}, FORCE, 1, 0.1, algorithm="jacobi")))
    here = cosim.run(path)
    cosim.export_ssp(path, folder / "s.ssp")
    there = cosim.run(folder / "s.ssp")
    return {"largest difference": max(float(np.abs(here[n] - there[n]).max()) for n in ("a.x", "b.x", "b.F"))}


SSP = [
    Case(
        "nested-systems", "SSP", "A gain of 3 in two systems within each other, the outer one with 10·y + 1; u = 5.",
        "y(1) = 10 · 3 · 5 + 1 = 151, at the component behind",
        {"": gains(system("root", component("a") + MIDDLE + component("b"),
                          connection("a.y", "middle.u") + connection("middle.y", "b.u"),
                          bindings(binding({"a.c": 5, "middle.inner.g.k": 3}))))},
        at(1.0, b_u=151.0),
    ),
    Case(
        "parameter-sets", "SSP", "Two sets for c of a component: 1 and then 2; 5 of its system, with a prefix.",
        "5: an outer set has priority (SSP 1.0, 4.5.2); k = 2, of the last inner set",
        {"": gains(system("root", component("a", inside=bindings(binding({"c": 1, "k": 4}), binding({"c": 2, "k": 2}))),
            "",
                          bindings(binding({"c": 5}, prefix="a."))))},
        [*at(1.0, a_y=5.0)],
    ),
    Case(
        "last-set", "SSP", "Two sets for c of a component: 1 and then 2.", "2: at one place the last has priority",
        {"": gains(system("root", component("a", inside=bindings(binding({"c": 1}), binding({"c": 2})))))},
        at(1.0, a_y=2.0),
    ),
    Case(
        "parameter-mapping", "SSP", "p = 4, mapped to k as it is and to c by 0.5·p + 1.", "c = 3",
        {"": gains(system("root", component("a"), "", bindings(binding({"p": 4}, mapping=MAPPING))))}, at(1.0, a_y=3.0),
    ),
    Case(
        "connection-transformation", "SSP", "y = 5 through a LinearTransformation with factor 2 and offset 1.",
        "u = 11",
        {"": gains(system("root", AB, connection("a.y", "b.u", linear(2, 1)), FIVE))}, at(1.0, b_u=11.0, b_y=11.0),
    ),
    Case(
        "reversed-connection", "SSP", "The same, written from the input to the output.",
        "u = 11: it acts from source to destination (SSP 1.0: the ends do not denote the direction)",
        {"": gains(system("root", AB, connection("b.u", "a.y", linear(2, 1)), FIVE))}, at(1.0, b_u=11.0, b_y=11.0),
    ),
    Case(
        "parameter-units", "SSP", "A parameter of 20 degC for an input in K, in a set that defines the unit.",
        "293.15 K",
        {"": ssp(lambda: (
            system("root", component("b", "cold", "K"), "", bindings(WARM)), {"cold": through("K").fmu()}))},
        at(1.0, b_y=293.15),
    ),
    Case(
        "connector-units", "SSP", "20 degC to a connector in K.", "293.15 K", {"": temperatures()}, at(1.0, b_y=293.15),
    ),
    Case(
        "suppressed-conversion", "SSP", "The same with `suppressUnitConversion`.", "20",
        {"": temperatures(suppressUnitConversion="true")}, at(1.0, b_y=20.0),
    ),
    Case(
        "horse-powers-ssp", "SSP", "100 hp of 735.49875 W into an FMU whose hp has 745.699872 W.",
        "98.6319…: units of FMUs belong to their file",
        {"": ssp(lambda: (
            system("root", component("a", "metric", inside=bindings(binding({"u": 100}))) + component("b",
                "mechanical"),
                   connection("a.y", "b.u")),
            {"metric": through("hp", METRIC_HP).fmu(), "mechanical": through("hp").fmu()}))},
        at(1.0, b_y=100 * 735.49875 / 745.699872),
    ),
    Case(
        "exported", "SSP", "Two masses by Jacobi, written by `export-ssp` and run.",
        "the numbers of the scenario, to the bit",
        {"": exported}, [Answer("largest difference", None, 0.0, 0)],
    ),
]  # fmt: skip

# -- verbs -------------------------------------------------------------------------------------------------

TOGGLE = Model(
    "toggle",
    (V("on", type="Boolean", start=False), V("n", type="Int32", start=0), V("x", start=0.0)),
    {"x": "1"},
    "n = (int)floor(time / 0.2 + 1e-9); on = n % 2;",
    depends={},
)
SHARP = Model("twice", (u(), V("y")), {}, "y = 2 * u;", depends={"y": ("u",)})
SECOND_ORDER = Model(
    "second",
    (u("r", 1.0), V("x", start=0.0), V("v", "local", start=0.0)),
    {"x": "v", "v": "r - x - 0.4 * v"},
    depends={},
)


def toggled(folder: Path) -> tuple[Any, Any]:
    """Return the runs of one FMU with rows of 0.1 and of 0.2 s."""
    return tuple(
        cosim.simulate(TOGGLE.fmu(), folder / name, stop=1.2, step=step, report=False)
        for name, step in (("a", 0.1), ("b", 0.2))
    )  # type: ignore[return-value]


def compared(first: int, second: int) -> Callable[[Path], Any]:
    def run(folder: Path) -> Any:
        pair = toggled(folder)
        found = cosim.compare(pair[first].folder, pair[second].folder, folder / "c", tolerance=0.01)
        return {"beyond": len(found.beyond)} | {d.name: d.largest for d in found.differences}

    return run


def differing(folder: Path) -> Any:
    runs_ = [cosim.run(scenario({"m": part(DECAY, start={"k": k})}, (), 1), folder / name, report=False)
             for name, k in (("a", 1), ("b", 2))]  # fmt: skip
    found = cosim.compare(runs_[0].folder, runs_[1].folder, folder / "c", tolerance=0.01)
    largest = next(d for d in found.differences if d.name == "m.x")
    return {"largest": largest.largest, "at": largest.at}


def units_compared(folder: Path) -> Any:
    first = table(folder / "a.csv", "time,w [rpm],v [km/h],s [m]", (0, 60, 36, 1), (1, 60, 36, 1))
    second = table(folder / "b.csv", "time,w [rad/s],v [m/s],s [m]", *((t, 2 * math.pi, 10, 1.5) for t in (0, 1)))
    return {d.name: d.largest for d in cosim.compare(first, second, folder / "c").differences}


def commanded(folder: Path) -> Any:
    """Return x and the exit codes of commands."""
    peak = {"criteria": {"peak": {"of": "m.x", "max": 0.5}}}
    loop = {"a": part(GAIN, start={"c": 1}), "b": part(GAIN)}
    for name, content in {
        "missed": scenario({"m": part(DECAY)}, (), 1, **peak),
        "loop": scenario(loop, ["a.y > b.u", "b.y > a.u"], 1),
        "wrong": scenario({"m": part(DECAY)}, (), 1, unknown=1),
    }.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    words = ("--set", "k=2", "--stop", "1", "--step", "0.1", "--out", "o", "--no-report")
    done = [command("simulate", DECAY.fmu(), *words, cwd=folder)]
    done += [command("run", f"{n}.json", "--out", n, "--no-report", cwd=folder) for n in ("missed", "loop", "wrong")]
    return {"x": cosim.read(folder / "o")["decay.x"][-1], "codes": [d.returncode for d in done]}


TIMES = np.arange(81) * 0.05


def replayed(folder: Path) -> Any:
    command = np.sin(3 * TIMES)
    log = table(folder / "log.csv", "time,u,y", *zip(TIMES.round(9), command, 2 * command + 0.1, strict=True))
    residual = cosim.replay(log, fmu=SHARP.fmu()).residual
    assert residual is not None
    values = residual["free_run.y"]
    return {"largest": float(values.max()), "least": float(values.min())}


def replayed_step(way: Any) -> Callable[[Path], Any]:
    """Return the largest residual of a log of x' = u, y = x + u, whose rows are the formula's."""

    def run(folder: Path) -> Any:
        command = (TIMES > 0.975).astype(float)
        x = np.maximum(0, TIMES - 1)
        log = table(folder / "log.csv", "time,u,x,y", *zip(TIMES.round(9), command, x, x + command, strict=True))
        ran = cosim.replay(log, fmu=DECLARED.fmu(2, way), start={"x": 0})
        assert ran.residual is not None
        return {name: float(np.nanmax(np.abs(ran.residual[f"free_run.{name}"]))) for name in ("x", "y")}

    return run


def linearized(_: Path) -> Any:
    found = cosim.linearize(LEFT.fmu(2, "me")).first
    poles = np.linalg.eigvals(found.A)
    return {"A": found.A, "B": found.B, "C": found.C, "D": found.D, "frequency": float(np.abs(poles[0]))}


def fitted(folder: Path) -> Any:
    times = np.arange(0, 4.01, 0.1).round(9)
    log = table(folder / "log.csv", "time,x", *zip(times, np.exp(-0.7 * times), strict=True))
    return {"k": cosim.fit([log], DECAY.fmu(), vary=["k"]).values["k"]}


def judged(_: Path) -> Any:
    criteria = {
        "settling_time": {"of": "m.x", "band": 0.05, "max": 9},
        "effort": {"of": "m.x", "max": 9},
        "rms_error": {"of": "m.x", "max": 9},
        "peak": {"of": "m.x", "max": 9},
        "final_error": {"of": "m.x", "max": 9},
    }
    ran = cosim.run(scenario({"m": part(DECAY)}, (), 5, 0.001, criteria=criteria))
    return {c["kind"]: c["value"] for c in ran.criteria}


def overshot(_: Path) -> Any:
    ran = cosim.run(scenario({"m": part(SECOND_ORDER)}, (), 10, 0.001,
                             criteria={"overshoot": {"of": "m.x", "to": 1, "max": 9}}))  # fmt: skip
    return {c["kind"]: c["value"] for c in ran.criteria}


VERB = [
    Case(
        "compare-held", "verb",
        "One FMU with rows each 0.1 s and each 0.2 s: a Boolean and an integer that change each 0.2 s, x = t.",
        "no difference in either direction: discrete values hold between rows",
        {"a, b": compared(0, 1), "b, a": compared(1, 0)},
        [Answer("beyond", None, 0, 0), Answer("toggle.on", None, 0.0, 0), Answer("toggle.n", None, 0.0, 0),
         Answer("toggle.x", None, 0.0, 1e-9)],
    ),
    Case(
        "compare-units", "verb", "60 rpm and 36 km/h in one file, 2π rad/s and 10 m/s in the other; 1 m and 1.5 m.",
        "no difference; 0.5 m", {"": units_compared},
        [Answer("w", None, 0.0), Answer("v", None, 0.0), Answer("s", None, 0.5)],
    ),
    Case(
        "command-line", "verb",
        "`cosim simulate` of x' = −k x with `--set k=2`; a criterion that is missed; loop gain 1.",
        "x(1) = e^−2 and exit code 0; 5; 4; 2 for an unknown key", {"": commanded},
        [Answer("x", None, math.exp(-2)), Answer("codes", None, [0, 5, 4, 2], 0)],
    ),
    Case(
        "compare-curves", "verb", "e^−t and e^−2t in rows of 0.1 s.",
        "the largest difference is e^−0.7 − e^−1.4 = 0.24999, at 0.7 s",
        {"": differing}, [Answer("largest", None, math.exp(-0.7) - math.exp(-1.4)), Answer("at", None, 0.7)],
    ),
    Case(
        "replay-residual", "verb", "A log of y = 2 u + 0.1 and an FMU of y = 2 u.",
        "measured − model = 0.1 in every row",
        {"": replayed}, [Answer("largest", None, 0.1), Answer("least", None, 0.1)],
    ),
    Case(
        "replay-step", "verb", "A log of x' = u, y = x + u with a step of u at 1 s, by formula, and an FMU of them.",
        "no residual: a row's command acts from its time", {way: replayed_step(way) for way in ("cs", "me")},
        [Answer("x", None, 0.0, 1e-6), Answer("y", None, 0.0, 1e-6)], because="model exchange: CVODE at 1e-5 a step",
    ),
    Case(
        "linearized-mass", "verb", "x'' = −10 x − 0.1 v + 4 (x₂ − x) + 0.2 (v₂ − v).",
        "A = (0 1; −14 −0.3), B = (0 0; 4 0.2), C = 1, D = 0; |λ| = √14",
        {"": linearized},
        [Answer("A", None, np.array([[0, 1], [-14, -0.3]]), 1e-6),
            Answer("B", None, np.array([[0, 0], [4, 0.2]]), 1e-6),
         Answer("C", None, np.eye(2), 1e-6), Answer("D", None, np.zeros((2, 2)), 1e-6),
         Answer("frequency", None, math.sqrt(14), 1e-6)],
        because="central differences",
    ),
    Case(
        "fitted-parameter", "verb", "A log of e^−0.7t and x' = −k x with k = 1.", "k = 0.7", {"": fitted},
        [Answer("k", None, 0.7, 1e-5)], because="the search ends at a relative change of 1e-6",
    ),
    Case(
        "criteria-of-a-decay", "verb", "Criteria of x = e^−t over 5 s, rows of 1 ms.",
        "settling time ln 20, effort 1 − e^−5, rms √((1 − e^−10)/10), peak 1, final error e^−5", {"": judged},
        [Answer("settling_time", None, math.log(20), 1e-3), Answer("effort", None, 1 - math.exp(-5), 1e-3),
         Answer("rms_error", None, math.sqrt((1 - math.exp(-10)) / 10), 1e-3), Answer("peak", None, 1.0),
         Answer("final_error", None, math.exp(-5))],
        because="rows of 1 ms",
    ),
    Case(
        "overshoot", "verb", "A step of x'' = 1 − x − 0.4 x', damping 0.2.", "exp(−π 0.2/√0.96) = 0.5266",
        {"": overshot},
        [Answer("overshoot", None, math.exp(-math.pi * 0.2 / math.sqrt(0.96)), 1e-5)], because="rows of 1 ms",
    ),
]  # fmt: skip
CASES = [*SSP, *VERB]
