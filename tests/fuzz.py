"""Files and options made wrong at random: `python -m tests.fuzz N [SEED]`, which `make fuzz` calls.

Every example is a file of one kind, changed in its parts, its text or its bytes, and given to the command that reads
it. Wrong is an exception that is none of ours, an exit code that is not in the contract, a word of Python's own in a
message, more than 5 s, and a file that is left anywhere but in the output folder.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import math
import os
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock
from xml.etree import ElementTree

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from cosim.base.errors import CosimError
from cosim.base.scratch import process_folder
from cosim.scenario.scenario_file import ScenarioFile
from cosim.verbs.cli import entry

ROOT = Path(__file__).resolve().parent.parent
EXITS = {0, 2, 3, 4, 5, 124, 130}
LONGEST = 5.0  # [s] of the processor
MOST_STEPS = 300  # of a run that is tried: one that is long by its scenario is no fault
INTERNAL = (
    "Traceback", "NoneType", "object has no", "[Errno", "KeyError", "TypeError", "AttributeError", "IndexError",
    "not subscriptable", "codec can't", "<class", "pydantic", "instance of", "ruamel", "positional argument",
)  # fmt: skip

SCENARIO: dict[str, Any] = {
    "name": "small", "description": "two references and an FMU", "duration": 0.4, "step": 0.02, "start_time": 0,
    "seed": 1, "algorithm": "gauss-seidel", "noise": True,
    "components": {
        "plant": {
            "fmu": "plant.fmu", "start": {"mass": 0.8, "psi_start": "12 deg"}, "tolerance": 1e-5,
        },
        "steps": {"block": "reference", "signals": {
            "duty": {"unit": "%", "start": 6.4, "changes": [{"at": 0.1, "to": 6.5}, {"at": 0.2, "to": 6.4, "rate": 1}]},
            "tilt": {"unit": "deg", "start": 1},
        }},
        "log": {"block": "playback", "file": "log.csv"},
    },
    "connections": [
        {"from": "steps.duty", "to": "plant.duty_right", "noise": {"variance": 1e-6, "bias": 0.01}},
        {"from": "steps.duty", "to": "plant.duty_left"},
        {"from": "steps.tilt", "to": "plant.tilt_right"},
    ],
    "record": ["plant.mass", "plant.*_start"], "limits": {"step": "5 s", "total": 20, "memory": "2 GB"},
    "events": [{"at": 0.1, "set": {"plant.tilt_left": 0.1}}],
    "faults": [
        {"on": "plant.duty_right", "kind": "bias", "value": 0.1, "from": 0.1, "to": 0.2},
        {"on": "plant.tilt_right", "kind": "dropout", "probability": 0.5}, {"on": "plant.duty_left", "kind": "freeze"},
        {"on": "plant.tilt_right", "kind": "delay", "delay": 0.04},
    ],
    "criteria": {
        "settling_time": {"of": "plant.psi", "to": 0.2, "band": 1, "max": 5},
        "peak": [{"of": "plant.psi", "to": "steps.tilt", "after": 0.1, "until": 0.3, "max": 9}],
    },
}  # fmt: skip
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="m" guid="{1}" numberOfEventIndicators="0">
<CoSimulation modelIdentifier="m" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions><Unit name="rad"><BaseUnit rad="1" factor="1" offset="0"/><DisplayUnit name="deg" factor="57.29578"/>
</Unit></UnitDefinitions>
<TypeDefinitions><SimpleType name="E"><Enumeration><Item name="a" value="1"/><Item name="b" value="2"/></Enumeration>
</SimpleType></TypeDefinitions>
<DefaultExperiment startTime="0" stopTime="1" tolerance="1e-4" stepSize="0.01"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="rad" min="-1" max="1"/>
</ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real unit="rad" derivative="3"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="local"><Real/></ScalarVariable>
<ScalarVariable name="k" valueReference="3" causality="parameter" variability="fixed"><Integer start="2"/>
</ScalarVariable>
<ScalarVariable name="e" valueReference="4" causality="parameter" variability="tunable">
<Enumeration declaredType="E" start="1"/></ScalarVariable>
<ScalarVariable name="s" valueReference="5" causality="parameter" variability="fixed"><String start="text"/>
</ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="2" dependencies="1" dependenciesKind="dependent"/></Outputs>
<InitialUnknowns><Unknown index="2"/></InitialUnknowns></ModelStructure></fmiModelDescription>
"""
STRUCTURE = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription name="s" version="1.0" xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
 xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
 xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
 xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"><ssd:System name="root"><ssd:Connectors>
<ssd:Connector name="drive" kind="input"><ssc:Real unit="deg"/></ssd:Connector></ssd:Connectors>
<ssd:ParameterBindings><ssd:ParameterBinding prefix="one."><ssd:ParameterValues>
<ssv:ParameterSet version="1.0" name="p"><ssv:Parameters>
<ssv:Parameter name="m"><ssv:Real value="0.8" unit="kg"/></ssv:Parameter></ssv:Parameters>
</ssv:ParameterSet></ssd:ParameterValues><ssd:ParameterMapping><ssm:ParameterMapping version="1.0">
<ssm:MappingEntry source="one.m" target="one.mass"><ssc:LinearTransformation factor="1" offset="0"/></ssm:MappingEntry>
</ssm:ParameterMapping></ssd:ParameterMapping></ssd:ParameterBinding>
<ssd:ParameterBinding source="p.ssv"/></ssd:ParameterBindings>
<ssd:Elements><ssd:Component name="one" source="plant.fmu" implementation="CoSimulation"><ssd:Connectors>
<ssd:Connector name="tilt_left" kind="input"><ssc:Real unit="deg"/></ssd:Connector>
<ssd:Connector name="psi" kind="output"><ssc:Real/></ssd:Connector></ssd:Connectors></ssd:Component>
<ssd:System name="in"><ssd:Connectors><ssd:Connector name="a" kind="input"/></ssd:Connectors><ssd:Elements>
<ssd:Component name="two" source="plant.fmu"><ssd:Connectors><ssd:Connector name="tilt_right" kind="input"/>
</ssd:Connectors></ssd:Component></ssd:Elements>
<ssd:Connections><ssd:Connection startConnector="a" endElement="two" endConnector="tilt_right"/></ssd:Connections>
</ssd:System></ssd:Elements><ssd:Connections><ssd:Connection startElement="one" startConnector="psi" endElement="in"
 endConnector="a" suppressUnitConversion="false"><ssc:LinearTransformation factor="0.1"/></ssd:Connection>
<ssd:Connection startConnector="drive" endElement="one" endConnector="tilt_left"/></ssd:Connections></ssd:System>
<ssd:Units><ssc:Unit name="deg"><ssc:BaseUnit rad="1" factor="0.017453"/></ssc:Unit></ssd:Units>
<ssd:DefaultExperiment startTime="0" stopTime="0.1"/></ssd:SystemStructureDescription>
"""
VALUES = """<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet version="1.0" name="p" xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues">
<ssv:Parameters><ssv:Parameter name="drive"><ssv:Real value="1"/></ssv:Parameter>
<ssv:Parameter name="in.two.roll_ground_effect"><ssv:Boolean value="true"/></ssv:Parameter></ssv:Parameters>
</ssv:ParameterSet>
"""
NAMES = (
    "time",
    "duty_right",
    "duty_left",
    "tilt_right [deg]",
    "tilt_left [deg]",
    "psi [deg]",
    "psi_dot",
    "battery [V]",
)

ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 1e308, -1e-320, 10**400, float("inf"), float("nan"), "", " ", "x]", "[key]",
    "«fmu»",
    "a.b", "..", "../../../evil", "/", "\\", "\0", "\ud7ff", "ψ", "🙂", "x" * 3000, "12 deg", "1e5", "nan", "{}",
    "[]", [], {}, [[]], [None], {"": ""}, {"a": {"b": [1]}}, ["a", 1, None], "~", "*", "&a", "%s%n", "{0}", "plant.fmu",
    "log.csv", ".", "plant", "plant.psi", "on", "off", "2020-01-01", "0x1F", "1_000", "base", "hovercraft", "a.py:B",
    "C:\\x", "\n", "'", '"',
)  # fmt: skip
TOKENS = (
    "[", "]", "{", "}", ":", ": ", "- ", "? ", "&a ", "*a", "<<: ", "|", ">", "!!", "!!binary ", "#", "'", '"', "\t",
    ",", "\n", "\r", "\0", "%YAML 1.1\n", "---\n", "...\n", "=", "1e999", "-", ";", "\ufeff", "<!DOCTYPE x>", "<x>",
    "&lt;", "&x;", "]]>", "<!--", "<?xml?>", "0" * 400, "\x85", "nan", "inf", "null", "é", "?{a: b}\n: 1\n",
)  # fmt: skip

MEANT = (
    "2.0",
    "3.0",
    "1.0",
    "../m",
    "output",
    "parameter",
    "independent",
    "calculated",
    "exact",
    "fixed",
    "0",
    "7",
    "rad",
)
NUMBERS = (0, -1, 1e-300, 1e300, 3.4e38, "1e999", "-0", "nan", "inf", "1,5", "0x1", "1_0", " 2 ", "", "٣")


@dataclass
class Found:
    """What a fuzz met."""

    count: Counter[str] = field(default_factory=Counter)
    exits: Counter[int] = field(default_factory=Counter)
    slowest: tuple[float, str] = (0.0, "")
    wrong: list[str] = field(default_factory=list)


# -- what is changed --------------------------------------------------------------------------------


def places(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place within plain data."""
    yield at
    parts = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in parts:
        yield from places(value, (*at, key))


def changed(draw: Callable[[Any], Any], data: Any) -> Any:
    """Return plain data with one to three parts replaced, removed, doubled, renamed or wrapped."""
    data = copy.deepcopy(data)
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        where = draw(st.sampled_from(list(places(data))[1:] or [()]))
        if not where:
            return draw(st.sampled_from(ODD))
        node = data
        for step in where[:-1]:
            node = node[step]
        last, odd = where[-1], draw(st.sampled_from(ODD))
        match draw(st.sampled_from(("replace", "replace", "remove", "rename", "wrap", "swap", "add"))):
            case "replace":
                node[last] = copy.deepcopy(odd)
            case "remove":
                del node[last]
            case "rename" if isinstance(node, dict):
                node[str(odd)[:300]] = node.pop(last)
            case "wrap":
                node[last] = draw(st.sampled_from(([node[last]], {"a": node[last]}, str(node[last]))))
            case "swap":
                other = draw(st.sampled_from(list(places(data))[1:]))
                node[last] = copy.deepcopy(found_at(data, other))
            case _ if isinstance(node, list):
                node.append(copy.deepcopy(odd))
            case _:
                node[str(odd)[:300]] = copy.deepcopy(node[last])
    return data


def found_at(data: Any, where: tuple[Any, ...]) -> Any:
    for step in where:
        data = data[step]
    return data


def mangled(draw: Callable[[Any], Any], text: str) -> str:
    """Text with a few pieces cut, doubled or put in."""
    for _ in range(draw(st.sampled_from((1, 1, 2, 4)))):
        a = draw(st.integers(0, len(text)))
        b = min(len(text), a + draw(st.integers(0, 40)))
        match draw(st.sampled_from(("cut", "put", "put", "double", "swap", "end"))):
            case "cut":
                text = text[:a] + text[b:]
            case "put":
                text = text[:a] + draw(st.sampled_from(TOKENS)) + text[a:]
            case "double":
                text = text[:b] + text[a:b] * draw(st.sampled_from((1, 3, 100))) + text[b:]
            case "swap":
                text = text[:a] + str(draw(st.sampled_from(ODD)))[:500] + text[b:]
            case "end":
                text = text[:a]
    return text


def written(draw: Callable[[Any], Any], data: Any) -> bytes:
    """Return a document, changed in its parts or its text or both, as YAML or JSON."""
    parts = draw(st.integers(0, 3)) > 0
    text = as_text(changed(draw, data) if parts else data, draw(st.booleans()))
    if not parts or draw(st.integers(0, 3)) == 0:
        text = mangled(draw, text)
    return raw(draw, text)


def altered(draw: Callable[[Any], Any], xml: str) -> str:
    """Return well-formed XML with attributes and elements replaced, removed, doubled or renamed."""
    root = ElementTree.fromstring(xml.partition("?>")[2])
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 4)))):
        parents = list(root.iter())
        node = draw(st.sampled_from(parents))
        odd = re.sub(r"[^\t\n\x20-\ud7ff]", "", str(draw(st.sampled_from(ODD))))[:400]
        match draw(st.sampled_from(("set", "set", "set", "drop", "remove", "double", "rename", "text"))):
            case "set" if node.attrib:
                node.set(draw(st.sampled_from(sorted(node.attrib))), draw(st.sampled_from((odd, *MEANT))))
            case "drop" if node.attrib:
                del node.attrib[draw(st.sampled_from(sorted(node.attrib)))]
            case "remove" | "double" if len(node):
                child = draw(st.sampled_from(list(node)))
                node.remove(child) if draw(st.booleans()) else node.append(copy.deepcopy(child))
            case "rename":
                node.tag = draw(st.sampled_from([p.tag for p in parents] + ["Other", "Integer", "Boolean", "Clock"]))
            case _:
                node.text = odd
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode")


def recelled(draw: Callable[[Any], Any], text: str) -> str:
    """Return a table with some changed cells, columns or rows."""
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(draw(st.sampled_from((1, 1, 2, 5)))):
        row = draw(st.sampled_from(rows))
        cell = draw(st.integers(0, len(row) - 1))
        match draw(st.sampled_from(("cell", "cell", "header", "column", "row", "swap"))):
            case "cell":
                row[cell] = str(draw(st.sampled_from((*ODD, *NUMBERS))))[:300]
            case "header":
                rows[0][cell % len(rows[0])] = draw(
                    st.sampled_from((*NAMES, "psi [m]", "x[1]", '"a,b"', "", "Time", "t [ms]"))
                )
            case "column":
                value = str(draw(st.sampled_from(NUMBERS)))
                for other in rows[1:]:
                    other[cell % len(other)] = value
            case "row":
                rows.append(list(row))
            case "swap":
                rows[-1], rows[1 % len(rows)] = rows[1 % len(rows)], rows[-1]
    return "\n".join(map(",".join, rows)) + "\n"


def raw(draw: Callable[[Any], Any], text: str) -> bytes:
    data = text.encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 15)) == 0:
        a = draw(st.integers(0, len(data)))
        data = data[:a] + draw(st.binary(max_size=8)) + data[a:]
    return data


def as_text(data: Any, block: bool) -> str:
    if not block:
        return json.dumps(data, indent=1, ensure_ascii=False)
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    stream = io.StringIO()
    try:
        YAML(typ="safe", pure=True).dump(data, stream)
    except (YAMLError, ValueError, TypeError):
        return json.dumps(data, ensure_ascii=False)
    return stream.getvalue()


def table(rows: int = 60, step: float = 0.02) -> str:
    lines = [",".join(NAMES)]
    lines += [f"{step * k:.2f},6.4,6.4,{k % 7},{k % 5},{0.1 * k:.2f},{0.087:.3f},12" for k in range(rows)]
    return "\n".join(lines) + "\n"


# -- kinds ------------------------------------------------------------------------------------------


def scenario(draw: Callable[[Any], Any], folder: Path) -> Iterator[list[str]]:
    path = folder / "case.yaml"
    path.write_bytes(written(draw, SCENARIO))
    yield ["check", path.name]
    if short(path):
        yield ["run", path.name, "--out", "out", "--force", "--no-report"]


def log(draw: Callable[[Any], Any], folder: Path) -> Iterator[list[str]]:
    path = folder / "case.csv"
    text = draw(st.sampled_from((recelled, mangled)))(draw, table(draw(st.sampled_from((0, 1, 2, 3, 40, 40)))))
    path.write_bytes(raw(draw, text))
    yield ["check", path.name]


def description(draw: Callable[[Any], Any], folder: Path) -> Iterator[list[str]]:
    path = folder / "case.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "modelDescription.xml", raw(draw, draw(st.sampled_from((altered, altered, mangled)))(draw, DESCRIPTION))
        )
        archive.writestr("binaries/linux64/m.so", b"\x7fELF")
    if draw(st.integers(0, 4)) == 0:  # the archive itself
        data = path.read_bytes()
        a = draw(st.integers(0, len(data)))
        path.write_bytes(data[:a] + draw(st.binary(max_size=30)) + data[a + draw(st.integers(0, 30)) :])
    yield ["check", path.name]
    name = draw(st.sampled_from(("", "", "u", "k", "e", "s", "y", "z")))
    start = {name: draw(st.sampled_from(ODD[:20]))} if name else {}
    content = {
        "name": "n", "duration": 0.1, "step": 0.05,
        "components": {"m": {"fmu": path.name, "start": start}, "r": {"block": "reference", "signals": {"x": {}}}},
        "connections": [{"from": "r.x", "to": "m.u"}],
    }  # fmt: skip
    (folder / "with.yaml").write_text(json.dumps(content))
    yield ["run", "with.yaml", "--out", "out", "--force", "--no-report"]


def structure(draw: Callable[[Any], Any], folder: Path) -> Iterator[list[str]]:
    texts = {"SystemStructure.ssd": STRUCTURE, "p.ssv": VALUES}
    name = draw(st.sampled_from(("SystemStructure.ssd", "SystemStructure.ssd", "p.ssv")))
    made = {n: text.encode() for n, text in texts.items()}
    made[name] = raw(draw, draw(st.sampled_from((altered, altered, mangled)))(draw, texts[name]))
    if draw(st.booleans()):
        path = folder / "case.ssp"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.write(folder / "plant.fmu", draw(st.sampled_from(("plant.fmu", "plant.fmu", "../plant.fmu", "p"))))
            for each, data in made.items():
                archive.writestr(each, data)
    else:
        path = folder / "SystemStructure.ssd"
        for each, data in made.items():
            (folder / each).write_bytes(data)
    yield ["check", path.name, "--no-load"]
    short_run = ("--no-report", "--in-process", "--set", "step=0.02", "--set", "duration=0.04")
    yield ["run", path.name, "--out", "out", "--force", *short_run]


KINDS = {"scenario": scenario, "log": log, "description": description, "ssp": structure}


def short(path: Path, options: list[str] | None = None) -> bool:
    """Whether a run would be over soon, as far as its scenario can be read."""
    try:
        return ScenarioFile(path, options or ()).scenario.steps <= MOST_STEPS
    except CosimError:
        return True


# -- what is done with it ---------------------------------------------------------------------------


def prepared(folder: Path, plant: Path) -> Path:
    """Return a nested folder with the files for examples; writes outside it are detectable."""
    work = folder / "a" / "b" / "c" / "d"
    work.mkdir(parents=True)
    shutil.copy(plant, work / "plant.fmu")
    for name, step in (("log.csv", 0.02), ("other.csv", 0.021), ("sealed.csv", 0.019)):
        (work / name).write_text(table(300, step))
    (folder / "tmp").mkdir()
    return work


def tried(arguments: list[str]) -> tuple[int | None, str]:
    """Return the exit code of a command, None after an unexpected exception, and its output."""
    said = io.StringIO()
    typed = mock.patch.object(sys, "argv", ["cosim", *arguments])
    with typed, contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            entry()
        except SystemExit as end:
            return (end.code if isinstance(end.code, int) else 0 if end.code is None else 1), said.getvalue()
        except BaseException:
            return None, said.getvalue() + traceback.format_exc()
    return 0, said.getvalue()


def hold(found: Found, kind: str, root: Path, work: Path, example: Iterator[list[str]], longest: float) -> None:
    """Run the commands of an example and note their faults."""
    before = set(work.iterdir())
    made: set[Path] = set()
    for arguments in example:
        made |= set(work.iterdir()) - before - {work / "out"}  # the example's own files
        outside = everything(root, work)
        began = time.process_time()
        code, said = tried(arguments)
        took = time.process_time() - began
        found.slowest = max(found.slowest, (took, f"{kind}: {arguments[0]}"))
        found.exits[-1 if code is None else code] += 1
        moved = Path.cwd() != work.resolve()
        os.chdir(work)
        left = everything(root, work) - outside
        reasons = [
            *([f"exit {code}"] if code not in EXITS else []),
            *(f"says {word!r}" for word in INTERNAL if code is not None and word in said),
            *(["another folder"] if moved else []),
            *([f"{took:.1f} s"] if took > longest else []),
            *([f"left {', '.join(map(str, sorted(left)[:3]))}"] if left else []),
        ]
        if reasons:
            files = "\n".join(f"--- {p.name}\n{p.read_bytes()[:3000]!r}" for p in sorted(made) if p.is_file())
            found.wrong.append(f"{kind} {arguments}: {'; '.join(reasons)}\n{said[-2500:]}\n{files}")
    for path in set(work.iterdir()) - before:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    found.count[kind] += 1


def everything(root: Path, work: Path) -> set[Path]:
    """Return all files except files in output folders."""
    return {p for p in root.rglob("*") if not p.is_relative_to(work / "out")}


def fuzz(
    kind: str, count: int, number: int, folder: Path, plant: Path, most_wrong: int = 1, longest: float = math.inf
) -> Found:
    """Run `count` examples of a kind, drawn by a seed, each for at most `longest` [s]; stop after enough faults."""
    found, work = Found(), prepared(folder, plant)

    @seed(number)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def one(data: st.DataObject) -> None:
        if len(found.wrong) < most_wrong:
            hold(found, kind, folder, work, KINDS[kind](data.draw, work), longest)

    here, temporary = Path.cwd(), tempfile.tempdir
    try:
        os.chdir(work)
        tempfile.tempdir = str(folder / "tmp")
        process_folder()  # which stays until this process ends, whatever a command does
        one()
    finally:
        os.chdir(here)
        tempfile.tempdir = temporary
    return found


def main() -> None:
    """Run examples of every kind in turn; print faults and exit with code 1 if there are any."""
    from cosim.fmi.fmu_build import build
    from fmus.recipes import plant_recipe

    total = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    first = int(sys.argv[2]) if len(sys.argv) > 2 else time.time_ns() % 1_000_000
    kinds = sys.argv[3].split(",") if len(sys.argv) > 3 else list(KINDS)
    wrong: list[str] = []
    share = total / len(kinds)
    with tempfile.TemporaryDirectory() as folder:
        plant = build(plant_recipe(), Path(folder) / "plant.fmu")
        for kind in kinds:
            found = fuzz(
                kind,
                math.ceil(share),
                first,
                Path(folder) / kind,
                plant,
                most_wrong=20,
                longest=LONGEST,
            )
            exits = ", ".join(f"{code}: {n}" for code, n in sorted(found.exits.items()))
            slowest = f"slowest {found.slowest[0]:.2f} s"
            print(
                f"{kind}: {found.count[kind]} examples, exits {{{exits}}}, {slowest}, {len(found.wrong)} wrong",
                flush=True,
            )
            wrong += found.wrong
            for text in found.wrong:
                print(f"\n{text}", flush=True)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"seed {first}, {len(wrong)} wrong, at most {memory:.0f} MB")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
