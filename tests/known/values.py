"""Units and types: the same quantity or value through every way in and out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.kit import Model, tag
from tests.known.sources import DIRECT
from tests.known.table import (
    Answer,
    Case,
    Door,
    Run,
    at,
    failing,
    found,
    part,
    put,
    recorded,
    reference,
    run,
    simulated,
    value_of,
)

UNITS: dict[str, dict[str, Any]] = {
    "K": {"K": 1},
    "degC": {"K": 1, "offset": 273.15},
    "degF": {"K": 1, "factor": 0.5555555555555556, "offset": 255.37222222222223},
    "rpm": {"s": -1, "rad": 1, "factor": 0.10471975511965977},
    "rad/s": {"s": -1, "rad": 1},
    "km/h": {"m": 1, "s": -1, "factor": 0.2777777777777778},
    "m/s": {"m": 1, "s": -1},
    "rad": {"rad": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "W": {"kg": 1, "m": 2, "s": -3},
    "hp": {"kg": 1, "m": 2, "s": -3, "factor": 745.699872},
    "L/100km": {"m": 2, "factor": 1e-8},
}
METRIC_HP = UNITS["hp"] | {"factor": 735.49875}
OWN_HP = 735.49875 / 745.699872


def through(unit: str, base: dict[str, Any] | None = None, display: str = "", relative: str = "") -> Model:
    """Return y = u, both in a unit."""
    definition = tag("Unit", tag("BaseUnit", **base or UNITS[unit]), display, name=unit)
    extra = f"{{unit={unit} {relative}}}"
    return Model(f"input u = 0 {extra}, y {extra}", "", "y = u;", DIRECT, units=definition)


def converted(value: float, source: Model, target: Model, version: int = 2, **wire: Any) -> Run:
    """Return the run that passes a value from one unit to another."""
    return run({"a": part(source, start={"u": value}), "m": part(target, version)}, {"a.y > m.u": wire}, 0.2)


def started(model: Model, value: str, version: int = 2) -> Run:
    """Return the run of `cosim.simulate` with a start value in a unit."""
    return put("start", part(model, version), {"u": value}, duration=0.2, door=simulated)


def pair(name: str, value: float, source: str, target: str, right: float, formula: str) -> Case:
    """Return the case of a value in two units, by a connection, a start value and an event."""
    a, b, text = through(source), through(target), f"{value:g} {source}"
    runs = {
        "connection": converted(value, a, b, 3),
        "start": started(b, text),
        "event": put("event", part(b), {"u": text}, 0.1, duration=0.2),
    }
    return Case(name, f"{text} into an input in {target}.", formula, runs, at(0.2, 1e-9 * abs(right), m_y=right))


def share_of(right: float) -> Door:
    """Return the door that runs a scenario and gives the last y relative to the right one."""
    return lambda content, _: {"share": cosim.run(content)["b.y"][-1] / right}


OWN_DISPLAY = through("K", None, tag("DisplayUnit", name="degX", factor=2, offset=-100))
OWN_DISPLAY_1 = replace(
    OWN_DISPLAY,
    units=tag("BaseUnit", tag("DisplayUnitDefinition", displayUnit="degX", gain=2, offset=-100), unit="K"),
)
CONSUMPTION = through("L/100km", None, tag("DisplayUnit", name="mpg", inverse=True, factor=235.214583))
RELATIVE = "relativeQuantity=true"
DIFFERENCE = through("K", relative=RELATIVE)

UNIT = [
    pair("degC-to-K", 20.0, "degC", "K", 293.15, "20 + 273.15 K"),
    pair("degF-to-K", 50.0, "degF", "K", 283.15, "(50 + 459.67)·5/9 K"),
    pair("rpm-to-rad/s", 60.0, "rpm", "rad/s", 2 * math.pi, "2π rad/s"),
    pair("km/h-to-m/s", 36.0, "km/h", "m/s", 10.0, "10 m/s"),
    Case(
        "horse-powers", "100 hp of an FMU that defines hp as 735.49875 W into an FMU that defines it as 745.699872 W.",
        "73549.875 W: definitions of units belong to their file (FMI 2.0, 2.2.2)",
        {f"FMI {v}": run({"a": part(through("hp", METRIC_HP), v, start={"u": 100}), "b": part(through("hp"), v),
                          "c": part(through("W"), v)}, "a.y > b.u, b.y > c.u", 0.2) for v in (2, 3)},
        at(0.2, 1e-6, c_y=73549.875) + at(0.2, b_y=100 * OWN_HP),
    ),
    Case(
        "temperature-difference", "A difference of 10 degC into an input in K, both `relativeQuantity`.",
        "10 K: offsets do not apply to differences (FMI 2.0, 2.2.2)",
        {"connection": converted(10.0, through("degC", relative=RELATIVE), DIFFERENCE),
         "start": started(DIFFERENCE, "10 degC")}, at(0.2, m_y=10.0),
    ),
    Case(
        "inverse-display-unit", "47 mpg for an input in L/100km with an inverse display unit.",
        "235.214583 / 47 = 5.004566 (FMI 3.0, 2.4.3.2)",
        {way: put(way, part(CONSUMPTION, 3), {"u": "47 mpg"}, 0.1, duration=0.2) for way in ("start", "event")},
        at(0.2, m_y=235.214583 / 47),
    ),
    Case(
        "display-unit", "100 degX for an input in K with the display unit degX = 2·K − 100.", "(100 + 100)/2 = 100 K",
        {f"FMI {v}": started(OWN_DISPLAY_1 if v == 1 else OWN_DISPLAY, "100 degX", v) for v in (1, 2, 3)},
        at(0.2, m_y=100.0),
    ),
    Case(
        "factor-1", "20 degC into K with `factor: 1`.", "20: the factor takes the place of the conversion",
        converted(20.0, through("degC"), through("K"), factor=1), at(0.2, m_y=20.0),
    ),
    Case(
        "unit-of-a-recording", "A recording of 60 rpm into rad/s, of 250 mV into V, of 10 degC into K.",
        "2π rad/s; 0.25 V; 283.15 K: scaled here by 2π, 0.25 and 283.15 to 1",
        {unit: run({"b": part(through(unit)), "r": recorded(header, (0, value), (200, value))}, "r.u > b.u", 0.2,
                   door=share_of(right))
         for header, value, unit, right in (
             ("time,u [rpm]", 60, "rad/s", 2 * math.pi), ("time [ms],u [mV]", 250, "V", 0.25),
             ("time,u [degC]", 10, "K", 283.15))},
        found({"share": 1.0}, 1e-12),
    ),
    Case(
        "time-of-a-recording", "A recording in ms: u is 0 and from 1000 ms on 1.", "u(0.9) = 0, u(1) = 1",
        run({"b": part(through("V")), "r": recorded("time [ms],u [V]", (0, 0), (1000, 1))}, "r.u > b.u"),
        at(0.9, b_y=0.0) + at(1.0, b_y=1.0),
    ),
    Case(
        "unit-of-a-reference", "A reference of 0 and from 0.1 s on with 90 deg/s up to 180 deg, into rad.",
        "u(1.1) = π/2, u(2.1) = π",
        run({"b": part(through("rad")), "r": reference(0, {"at": 0.1, "to": 180, "rate": 90}, unit="deg")},
            "r.u > b.u", 3),
        at(1.1, b_y=math.pi / 2) + at(2.1, b_y=math.pi) + at(3.0, b_y=math.pi),
    ),
]  # fmt: skip

# -- types -----------------------------------------------------------------------------------------------

EXTREMES: dict[str, Any] = {
    "Int8": -(2**7),
    "UInt8": 2**8 - 1,
    "Int16": -(2**15),
    "UInt16": 2**16 - 1,
    "Int32": -(2**31),
    "UInt32": 2**32 - 1,
    "Int64": 2**53 + 1,
    "UInt64": 2**64 - 1,
    "Boolean": True,
    "String": 'é ∫ "q" <x>',
    "Binary": "00ff10cafe",
    "Float32": 0.1,
    "Float64": 0.1 + 0.2,
}
ZEROS = {"Boolean": "false", "String": "", "Binary": ""}
COPIES = {"String": "strcpy(o_String, i_String);", "Binary": "o_Binary = i_Binary;"}
TYPED = Model(
    ", ".join(f"input {t} i_{t} = {ZEROS.get(t, 0)}, {t} o_{t}" for t in EXTREMES),
    "",
    " ".join(COPIES.get(t, f"o_{t} = i_{t};") for t in EXTREMES),
    {f"o_{t}": (f"i_{t}",) for t in EXTREMES},
)
RIGHT = EXTREMES | {"Float32": float(np.float32(0.1)), "Boolean": 1, "Binary": bytes.fromhex("00ff10cafe")}
NODE = Model(
    "hidden Binary rx = , Binary tx = cafe, Int32 size",
    "",
    "size = rx.size; if (rx.size) tx = rx;",
)
ITEMS = tag("Item", name="low", value=1) + tag("Item", name="high", value=7)
GEARS3 = Model(  # an enumeration y is the input u, and an integer n is its number
    "input Enumeration u = 1 {declaredType=Gear}, Enumeration y {declaredType=Gear}, Int32 n, x",
    "",
    "y = u; n = u; x = u;",
    {"y": ("u",), "n": ("u",), "x": ("u",)},
    types=tag("EnumerationType", ITEMS, name="Gear"),
)
GEARS2 = replace(GEARS3, types=tag("SimpleType", tag("Enumeration", ITEMS), name="Gear"))
ARRAY = Model(
    "input a[3] = 1 2 3, b[3], total",
    "",
    "for (int k = 0; k < 3; k++) b[k] = 2 * a[k]; total = a[0] + 10 * a[1] + 100 * a[2];",
    {"b": ("a",), "total": ("a",)},
)
INTEGER = Model("input Int32 u = 0, Int32 y", "", "y = u;", DIRECT)
SWITCH = Model("input Boolean u = false, Boolean y, x = 0", "x' = u", "y = u;", DIRECT)
BYTE = Model("input Int8 u = 0, Int8 y", "", "y = u;", DIRECT)


def every_way(name: str, system: str, source: str, *kinds: str) -> Case:
    """Return the case of extreme values of some types, brought into inputs by each way."""
    component, values = part(TYPED, 3), {f"i_{t}": EXTREMES[t] for t in kinds}
    runs = {way: put(way, component, values, 0.1, duration=0.2) for way in ("start", "event", "playback")}
    wires = ", ".join(f"s.o_{t} > m.i_{t}" for t in kinds)
    for door, keys in (("connection", {}), ("own process", {"process": "own"})):
        runs[door] = run({"s": component | keys | {"start": values}, "m": component | keys}, wires, 0.2)
    return Case(name, system, source, runs, at(0.2, 0, **{f"m_o_{t}": RIGHT[t] for t in kinds}))


KEPT = ("Float64", "Float32", "Int64", "UInt64", "String", "Boolean")


def kept(format_: str) -> Run:
    """Return the run whose values are written to a file, read again, and played back."""

    def read(content: Any, folder: Path) -> dict[str, str]:
        cosim.run(content, folder / "out", report=False, format=format_)
        (file,) = (folder / "out").glob("results.*")
        recording, names = {"block": "playback", "file": str(file)}, [f"m.o_{t}" for t in KEPT if t != "Boolean"]
        wires = ", ".join(f"r.{name} > {name.replace('o_', 'i_')}" for name in names)
        again, played = cosim.read(folder / "out"), run({"r": recording, "m": part(TYPED, 3)}, wires, 0.2)(folder)
        for name in names:
            values = [str(value_of(ran, Answer(name, 0.2, None, 0))) for ran in (again, played)]
            assert values[0] == values[1], name
        return {t: str(value_of(again, Answer(f"m.o_{t}", 0.2, None, 0))) for t in KEPT}

    return put("start", part(TYPED, 3), {f"i_{t}": EXTREMES[t] for t in KEPT}, duration=0.2, door=read)


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
        "hidden-binary-input", "Two FMUs exchange ca fe; their Binary inputs cannot be read (as FMI 3.0 allows).",
        "both get 2 bytes: an input need not be readable",
        run({"a": part(NODE, 3), "b": part(NODE, 3)}, "a.tx > b.rx, b.tx > a.rx", 0.5),
        at(0.5, 0, b_tx=bytes.fromhex("cafe"), a_size=2, b_size=2),
    ),
    Case(
        "enumeration", "The item high, of value 7, by name into an enumeration, to another one, an Int32 and a Real.",
        "7 everywhere",
        {f"FMI {v}": run(
            {"a": part(model, v, start=start), "b": part(model, v), "i": part(INTEGER, v), "r": part(through("V"), v)},
            "a.y > b.u, a.y > i.u, a.y > r.u", 0.3, events=events)
         for v, model, start, events in (
             (2, GEARS2, {"u": "high"}, []), (3, GEARS3, {}, [{"at": 0.1, "set": {"a.u": "high"}}]))},
        at(0.3, b_y=7, b_n=7, b_x=7.0, i_y=7, r_y=7.0),
    ),
    Case(
        "boolean-into-numbers", "A Boolean that is true into an Int32 and a Real.", "1 and 1.0",
        {f"FMI {v}": run({"s": part(SWITCH, v, start={"u": True}), "i": part(INTEGER, v), "r": part(through("V"), v)},
                         "s.y > i.u, s.y > r.u", 0.2) for v in (1, 3)},
        at(0.2, i_y=1, r_y=1.0),
    ),
    Case(
        "played-boolean", "x' = on by a recording of the Boolean: true from 0.5 to 1 s.",
        "on(0.9) = 1, on(1) = 0, x(2) = 0.5",
        {f"FMI {v}": run({"m": part(SWITCH, v), "r": recorded("time,u", (0, 0), (0.5, 1), (1, 0))}, "r.u > m.u")
         for v in (1, 2)},
        at(0.4, m_y=0) + at(0.5, m_y=1) + at(0.9, m_y=1) + at(1.0, m_y=0) + at(2.0, m_x=0.5),
    ),
    Case(
        "array", "b = 2 a with a = (1, 2, 3), whole and by elements into another FMU.",
        "b = (2, 4, 6), (4, 8, 12); 642, 246",
        run({"m": part(ARRAY, 3), "n": part(ARRAY, 3), "o": part(ARRAY, 3)},
            "m.b > n.a, m.b[1] > o.a[3], m.b[2] > o.a[2], m.b[3] > o.a[1]", 0.2),
        at(0.2, m_total=321.0, n_total=642.0, o_total=246.0, **{f"n_b[{k}]": 4.0 * k for k in (1, 2, 3)}),
    ),
    Case(
        "array-start", "The same with a = (5, 6, 7) in `start`, whole or by elements.", "total = 5 + 60 + 700",
        {name: put("start", part(ARRAY, 3), start, duration=0.2) for name, start in (
            ("whole", {"a": [5, 6, 7]}), ("elements", {"a[3]": 7, "a[1]": 5, "a[2]": 6}))},
        at(0.2, m_total=765.0, **{"m_b[3]": 14.0}),
    ),
    Case(
        "out-of-range", "An Int32 of 128 into an Int8.", "exit code 4: values never wrap",
        run({"i": part(INTEGER, 3, start={"u": 128}), "b": part(BYTE, 3)}, "i.y > b.u", 0.2, door=failing),
        found({"exit code": 4}, 0),
    ),
    Case(
        "formats", "0.1 + 0.2, a single, 2⁵³ + 1, 2⁶⁴ − 1, a text and true in results of each format.",
        "the same values, read again and played back", {f: kept(f) for f in ("csv", "hdf5", "parquet", "mat")},
        found({t: str(float(RIGHT[t]) if t == "Boolean" else RIGHT[t]) for t in KEPT}, 0),
    ),
]  # fmt: skip
