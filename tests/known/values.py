"""Units and types: the same quantity or value through every way in and out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.couplings import fails
from tests.known.kit import C_TYPES, Model, V, u
from tests.known.table import Answer, Case, at, part, runs, scenario, table, value_of

UNITS = {
    "K": 'K="1"',
    "degC": 'K="1" offset="273.15"',
    "degF": 'K="1" factor="0.5555555555555556" offset="255.37222222222223"',
    "rpm": 's="-1" rad="1" factor="0.10471975511965977"',
    "rad/s": 's="-1" rad="1"',
    "km/h": 'm="1" s="-1" factor="0.2777777777777778"',
    "m/s": 'm="1" s="-1"',
    "rad": 'rad="1"',
    "V": 'kg="1" m="2" s="-3" A="-1"',
    "W": 'kg="1" m="2" s="-3"',
    "kg": 'kg="1"',
    "hp": 'kg="1" m="2" s="-3" factor="745.699872"',
    "kW": 'kg="1" m="2" s="-3" factor="1000"',
}
METRIC_HP = 'kg="1" m="2" s="-3" factor="735.49875"'


def through(unit: str, base: str = "", display: str = "", extra: str = "") -> Model:
    """Return y = u, both in a unit."""
    definition = f'<Unit name="{unit}"><BaseUnit {base or UNITS[unit]}/>{display}</Unit>'
    variables = (u(unit=unit, extra=extra), V("y", unit=unit, extra=extra))
    return Model("through", variables, {}, "y = u;", depends={"y": ("u",)}, units=definition)


def converted(
    value: float, source: Model, target: Model, version: int = 2, other: int = 2, **wire: Any
) -> Callable[[Path], Any]:
    """Return the run that passes a value from one unit to another."""
    return runs(
        lambda _: scenario(
            {"a": part(source, version, start={"u": value}), "b": part(target, other)},
            [{"from": "a.y", "to": "b.u"} | wire],
            0.2,
        )
    )


def started(model: Model, value: str, version: int = 2) -> Callable[[Path], Any]:
    """Return the run of `cosim.simulate` with a start value in a unit."""

    def run(_: Path) -> Any:
        ran = cosim.simulate(model.fmu(version), set={"u": value}, stop=0.2, step=0.1)
        return {"b.y": ran["through.y"][-1]}

    return run


def pair(name: str, value: float, source: str, target: str, right: float, formula: str) -> Case:
    """Return the case of a value in two units, by a connection, a start value and an event."""
    a, b = through(source), through(target)
    return Case(
        name,
        "unit",
        f"{value:g} {source} into an input in {target}.",
        formula,
        {
            "connection": converted(value, a, b, 2, 3),
            "start": started(b, f"{value:g} {source}"),
            "event": runs(
                lambda _: scenario({"b": part(b)}, (), 0.2, events=[{"at": 0.1, "set": {"b.u": f"{value:g} {source}"}}])
            ),
        },
        [Answer("b.y", 0.2, right, 1e-9 * abs(right))],
    )


def share_of(right: float, run: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """Return the last y of a run relative to the right one."""
    return lambda folder: {"share": run(folder)["b.y"][-1] / right}


def played(header: str, value: float, unit: str) -> Callable[[Path], Any]:
    """Return the run of a recording with a unit in its header."""
    return runs(
        lambda folder: scenario(
            {
                "b": part(through(unit)),
                "r": {"block": "playback", "file": table(folder / "u.csv", header, (0, value), (200, value))},
            },
            ["r.u > b.u"],
            0.2,
        )
    )


INVERSE = '<DisplayUnit name="mpg" inverse="true" factor="235.214583"/>'
CONSUMPTION = through("L/100km", 'm="2" factor="1e-8"', INVERSE)
OWN_DISPLAY = through("K", "", '<DisplayUnit name="degX" factor="2" offset="-100"/>')
OWN_DISPLAY_1 = replace(
    OWN_DISPLAY,
    units='<BaseUnit unit="K"><DisplayUnitDefinition displayUnit="degX" gain="2" offset="-100"/></BaseUnit>',
)
RELATIVE = 'relativeQuantity="true"'

UNIT = [
    pair("degC-to-K", 20.0, "degC", "K", 293.15, "20 + 273.15 K"),
    pair("degF-to-K", 50.0, "degF", "K", 283.15, "(50 + 459.67)·5/9 K"),
    pair("rpm-to-rad/s", 60.0, "rpm", "rad/s", 2 * math.pi, "2π rad/s"),
    pair("km/h-to-m/s", 36.0, "km/h", "m/s", 10.0, "10 m/s"),
    Case(
        "horse-powers", "unit",
        "100 hp of an FMU that defines hp as 735.49875 W into an FMU that defines it as 745.699872 W.",
        "73549.875 W: definitions of units belong to their file (FMI 2.0, 2.2.2)",
        {f"FMI {v}": runs(lambda _, v=v: scenario(
            {"a": part(through("hp", METRIC_HP), v, start={"u": 100}), "b": part(through("hp"), v),
                "c": part(through("W"), v)},
            ["a.y > b.u", "b.y > c.u"], 0.2)) for v in (2, 3)},
        [*at(0.2, 1e-6, c_y=73549.875), *at(0.2, 1e-9, b_y=100 * 735.49875 / 745.699872)],
    ),
    Case(
        "temperature-difference", "unit", "A difference of 10 degC into an input in K, both `relativeQuantity`.",
        "10 K: offsets do not apply to differences (FMI 2.0, 2.2.2)",
        {"connection": converted(10.0, through("degC", extra=RELATIVE), through("K", extra=RELATIVE)),
         "start": started(through("K", extra=RELATIVE), "10 degC")},
        at(0.2, b_y=10.0),
    ),
    Case(
        "inverse-display-unit", "unit", "47 mpg for an input in L/100km with an inverse display unit.",
        "235.214583 / 47 = 5.004566 (FMI 3.0, 2.4.3.2)", {"FMI 3": started(CONSUMPTION, "47 mpg", 3)},
        at(0.2, b_y=235.214583 / 47),
    ),
    Case(
        "display-unit", "unit", "100 degX for an input in K with the display unit degX = 2·K − 100.",
        "(100 + 100)/2 = 100 K",
        {"FMI 1": started(OWN_DISPLAY_1, "100 degX", 1)}
        | {f"FMI {v}": started(OWN_DISPLAY, "100 degX", v) for v in (2, 3)}, at(0.2, b_y=100.0),
    ),
    Case(
        "factor-1", "unit", "20 degC into K with `factor: 1`.", "20: the factor takes the place of the conversion",
        {"": converted(20.0, through("degC"), through("K"), factor=1)}, at(0.2, b_y=20.0),
    ),
    Case(
        "unit-of-a-recording", "unit", "A recording of 60 rpm into rad/s, of 250 mV into V, of 10 degC into K.",
        "2π rad/s; 0.25 V; 283.15 K: scaled here by 2π, 0.25 and 283.15 to 1",
        {unit: share_of(right, played(header, value, unit))
         for header, value, unit, right in (
             ("time,u [rpm]", 60, "rad/s", 2 * math.pi), ("time [ms],u [mV]", 250, "V", 0.25),
             ("time,u [degC]", 10, "K", 283.15))},
        [Answer("share", None, 1.0, 1e-12)],
    ),
    Case(
        "time-of-a-recording", "unit", "A recording in ms: u is 0 and from 1000 ms on 1.", "u(0.9) = 0, u(1) = 1",
        {"": runs(lambda folder: scenario(
            {"b": part(through("V")), "r": {"block": "playback", "file": table(
                folder / "u.csv", "time [ms],u [V]", (0, 0), (1000, 1))}}, ["r.u > b.u"], 2))},
        [*at(0.9, b_y=0.0), *at(1.0, b_y=1.0)],
    ),
    Case(
        "unit-of-a-reference", "unit", "A reference of 0 and from 0.1 s on with 90 deg/s up to 180 deg, into rad.",
        "u(1.1) = π/2, u(2.1) = π",
        {"": runs(lambda _: scenario({"b": part(through("rad")), "r": {"block": "reference", "signals": {"u": {
            "unit": "deg", "start": 0, "changes": [{"at": 0.1, "to": 180, "rate": 90}]}}}}, ["r.u > b.u"], 3))},
        [*at(1.1, b_y=math.pi / 2), *at(2.1, b_y=math.pi), *at(3.0, b_y=math.pi)],
    ),
]  # fmt: skip

# -- types -----------------------------------------------------------------------------------------------

LARGE = 2**53 + 1
EXTREMES = {
    "Int8": -(2**7),
    "UInt8": 2**8 - 1,
    "Int16": -(2**15),
    "UInt16": 2**16 - 1,
    "Int32": -(2**31),
    "UInt32": 2**32 - 1,
    "Int64": LARGE,
    "UInt64": 2**64 - 1,
    "Boolean": True,
    "String": 'é ∫ "q" <x>',
    "Binary": "00ff10cafe",
    "Float32": 0.1,
    "Float64": 0.1 + 0.2,
}
ZEROS = {"Boolean": False, "String": "", "Binary": "", "Float32": 0.0, "Float64": 0.0}
COPIES = {"String": "strcpy(o_String, i_String);", "Binary": "o_Binary = i_Binary;"}
TYPES = tuple(t for t in C_TYPES if t != "Enumeration")
TYPED = Model(
    "typed",
    (*(u(f"i_{t}", ZEROS.get(t, 0), type=t) for t in TYPES), *(V(f"o_{t}", type=t) for t in TYPES)),
    {},
    " ".join(COPIES.get(t, f"o_{t} = i_{t};") for t in TYPES),
    depends={f"o_{t}": (f"i_{t}",) for t in TYPES},
)
SINGLE = float(np.float32(0.1))
RIGHT = EXTREMES | {"Float32": SINGLE, "Boolean": 1, "Binary": bytes.fromhex("00ff10cafe")}
NODE = Model(
    "node",
    (u("rx", "", type="Binary", readable=False), V("tx", type="Binary", start="cafe"), V("size", type="Int32")),
    {},
    "size = rx.size; if (rx.size) tx = rx;",
    depends={"tx": (), "size": ()},
)
ITEMS = '<Item name="low" value="1"/><Item name="high" value="7"/>'
GEARS = f'<SimpleType name="Gear"><Enumeration>{ITEMS}</Enumeration></SimpleType>'
GEARS3 = f'<EnumerationType name="Gear">{ITEMS}</EnumerationType>'


def gears(version: int) -> Model:
    """Return an FMU whose enumeration y is its input u and whose integer n is its number."""
    kind = {"type": "Enumeration", "extra": 'declaredType="Gear"'}
    types = GEARS if version == 2 else GEARS3
    return Model(
        "gears",
        (u(start=1, **kind), V("y", **kind), V("n", type="Int32"), V("x")),
        {},
        "y = u; n = u; x = u;",
        depends={"y": ("u",), "n": ("u",), "x": ("u",)},
        types=types,
    )  # type: ignore[arg-type]


ARRAY = Model(
    "array",
    (u("a", [1.0, 2.0, 3.0], size=3), V("b", size=3), V("total")),
    {},
    "for (int k = 0; k < 3; k++) b[k] = 2 * a[k]; total = a[0] + 10 * a[1] + 100 * a[2];",
    depends={"b": ("a",), "total": ("a",)},
)
INTEGER = Model(
    "integer",
    (u(start=0, type="Int32"), V("y", type="Int32"), V("on", type="Boolean")),
    {},
    "y = u; on = u != 0;",
    depends={"y": ("u",), "on": ("u",)},
)
SWITCH = Model(
    "switch",
    (u(start=False, type="Boolean"), V("y", type="Boolean"), V("x", start=0.0)),
    {"x": "u"},
    "y = u;",
    depends={"y": ("u",), "x": ()},
)
BYTE = Model("byte", (u(start=0, type="Int8"), V("y", type="Int8")), {}, "y = u;", depends={"y": ("u",)})


def typed(kinds: tuple[str, ...], way: str) -> Callable[[Path], Any]:
    """Return the run that brings extreme values by one way into inputs."""

    def value(kind: str) -> Any:
        return EXTREMES[kind]

    def content(folder: Path) -> Any:
        m = part(TYPED, 3)
        if way == "start":
            return scenario({"m": m | {"start": {f"i_{t}": value(t) for t in kinds}}}, (), 0.2)
        if way == "event":
            events = [{"at": 0.1, "set": {f"m.i_{t}": value(t) for t in kinds}}]
            return scenario({"m": m}, (), 0.2, events=events)
        if way == "connection":
            source = m | {"start": {f"i_{t}": value(t) for t in kinds}}
            return scenario({"s": source, "m": m}, [f"s.o_{t} > m.i_{t}" for t in kinds], 0.2)
        header, row = ",".join(["time", *kinds]), [int(v) if isinstance(v := value(t), bool) else v for t in kinds]
        played = {"block": "playback", "file": table(folder / "u.csv", header, (0, *row), (1, *row))}
        return scenario({"r": played, "m": m}, [f"r.{t} > m.i_{t}" for t in kinds], 0.2)

    return runs(content)


def every_way(
    name: str,
    system: str,
    source: str,
    *kinds: str,
) -> Case:
    return Case(
        name,
        "type",
        system,
        source,
        {way: typed(kinds, way) for way in ("start", "event", "connection", "playback")},
        [Answer(f"m.o_{t}", 0.2, RIGHT[t], 0) for t in kinds],
    )


def kept(format_: str) -> Callable[[Path], Any]:
    """Return the values of a run that were written to a file and read again."""

    def run(folder: Path) -> Any:
        kinds = ("Float64", "Float32", "Int64", "UInt64", "String", "Boolean")
        start = {f"i_{t}": EXTREMES[t] for t in kinds}
        cosim.run(scenario({"m": part(TYPED, 3, start=start)}, (), 0.2), folder / "out", report=False, format=format_)
        ran = cosim.read(folder / "out")
        return {t: str(value_of(ran, Answer(f"m.o_{t}", 0.2, None))) for t in kinds}

    return run


TYPE = [
    every_way("small-integers", "The largest or smallest value of each type of 8 to 32 bits into an input of the type.",
              "the same value", *(f"{s}Int{b}" for b in (8, 16, 32) for s in ("", "U"))),
    every_way("int64", "2⁵³ + 1 into an Int64.", "9007199254740993, which no double has", "Int64"),
    every_way("uint64", "2⁶⁴ − 1 into a UInt64.", "18446744073709551615", "UInt64"),
    every_way("boolean", "True into a Boolean.", "true", "Boolean"),
    every_way("string", "A text with é, ∫, quotes and brackets into a String.", "the same text", "String"),
    every_way("binary", "The bytes 00 ff 10 ca fe into a Binary.", "the same bytes", "Binary"),
    every_way("reals", "0.1 into a Float32, 0.1 + 0.2 into a Float64.",
              "0.100000001490116…, the nearest single, and 0.30000000000000004, to the last bit", "Float32", "Float64"),
    Case(
        "hidden-binary-input", "type",
        "Two FMUs exchange ca fe; their Binary inputs cannot be read (as FMI 3.0 allows).",
        "both get 2 bytes: an input need not be readable", {"": runs(lambda _: scenario(
            {"a": part(NODE, 3), "b": part(NODE, 3)}, ["a.tx > b.rx", "b.tx > a.rx"], 0.5))},
        [Answer("b.tx", 0.5, bytes.fromhex("cafe"), 0), Answer("a.size", 0.5, 2, 0), Answer("b.size", 0.5, 2, 0)],
    ),
    Case(
        "enumeration", "type",
        "The item high, of value 7, by name into an enumeration, to another one, an Int32 and a Real.",
        "7 everywhere",
        {f"FMI {v}, {way}": runs(lambda _, v=v, way=way: scenario(
            {"a": part(gears(v), v, **({"start": {"u": "high"}} if way == "start" else {})), "b": part(gears(v), v),
             "i": part(INTEGER, v), "r": part(through("V"), v)},
            ["a.y > b.u", "a.y > i.u", "a.y > r.u"], 0.3,
            events=[] if way == "start" else [{"at": 0.1, "set": {"a.u": "high"}}]))
         for v, way in ((2, "start"), (3, "event"))},
        at(0.3, b_y=7, b_n=7, b_x=7.0, i_y=7, r_y=7.0),
    ),
    Case(
        "boolean-into-numbers", "type", "A Boolean that is true into an Int32 and a Real.", "1 and 1.0",
        {f"FMI {v}": runs(lambda _, v=v: scenario(
            {"s": part(SWITCH, v, start={"u": True}), "i": part(INTEGER, v), "r": part(through("V"), v)},
            ["s.y > i.u", "s.y > r.u"], 0.2)) for v in (1, 3)},
        at(0.2, i_y=1, r_y=1.0),
    ),
    Case(
        "played-boolean", "type", "x' = on by a recording of the Boolean: true from 0.5 to 1 s.",
        "on(0.9) = 1, on(1) = 0, x(2) = 0.5",
        {f"FMI {v}": runs(lambda folder, v=v: scenario(
            {"m": part(SWITCH, v), "r": {"block": "playback", "file": table(
                folder / "u.csv", "time,u", (0, 0), (0.5, 1), (1, 0))}}, ["r.u > m.u"])) for v in (1, 2)},
        [*at(0.4, m_y=0), *at(0.5, m_y=1), *at(0.9, m_y=1), *at(1.0, m_y=0), *at(2.0, m_x=0.5)],
    ),
    Case(
        "array", "type", "b = 2 a with a = (1, 2, 3), whole and by elements into another FMU.",
        "b = (2, 4, 6), (4, 8, 12); 642, 246",
        {"": runs(lambda _: scenario(
            {"m": part(ARRAY, 3), "n": part(ARRAY, 3), "o": part(ARRAY, 3)},
            ["m.b > n.a", "m.b[1] > o.a[3]", "m.b[2] > o.a[2]", "m.b[3] > o.a[1]"], 0.2))},
        [*(Answer(f"n.b[{k}]", 0.2, 4.0 * k) for k in (1, 2, 3)),
            *at(0.2, m_total=321.0, n_total=642.0, o_total=246.0)],
    ),
    Case(
        "array-start", "type", "The same with a = (5, 6, 7) in `start`.", "total = 5 + 60 + 700",
        {"": runs(lambda _: scenario({"m": part(ARRAY, 3, start={"a": [5, 6, 7]})}, (), 0.2))},
        [*at(0.2, m_total=765.0), Answer("m.b[3]", 0.2, 14.0)],
    ),
    Case(
        "out-of-range", "type", "An Int32 of 128 into an Int8.", "exit code 4: values never wrap",
        {"": fails(runs(lambda _: scenario({"i": part(INTEGER, 3, start={"u": 128}), "b": part(BYTE, 3)}, ["i.y > b.u"],
            0.2)))},
        [Answer("exit code", None, 4, 0)],
    ),
    Case(
        "formats", "type", "0.1 + 0.2, a single, 2⁵³ + 1, 2⁶⁴ − 1, a text and true in results of each format.",
        "the same values, read again", {f: kept(f) for f in ("csv", "hdf5")},
        [Answer(t, None, str(float(RIGHT[t]) if t == "Boolean" else RIGHT[t]), 0)
         for t in ("Float64", "Float32", "Int64", "UInt64", "String", "Boolean")],
    ),
]  # fmt: skip
CASES = [*UNIT, *TYPE]
