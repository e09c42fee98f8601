"""Files made wrong at random: `python -m tests.fuzz N [SEED]`, which `make fuzz` calls.

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
import shutil
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock
from xml.sax.saxutils import quoteattr

import yaml
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from cosim.core.errors import CosimError
from cosim.core.scratch import process_folder
from cosim.scenario.scenario_file import ScenarioFile
from cosim.verbs.cli import entry
from tests.corpus.inputs import FMU_SOURCES

Draw = Callable[[Any], Any]

EXITS = {0, 2, 3, 4, 5, 124, 130}
LONGEST = 5.0  # [s] of the processor
MOST_STEPS = 300  # of a run that is tried: one that is long by its scenario is no fault
INTERNAL = (
    "Traceback", "NoneType", "object has no", "[Errno", "KeyError", "TypeError", "AttributeError", "IndexError",
    "not subscriptable", "codec can't", "<class", "pydantic", "instance of", "ruamel", "positional argument",
)  # fmt: skip

SCENARIO = """
name: small
description: two references and an FMU
duration: 0.4
step: 0.02
start_time: 0
seed: 1
algorithm: gauss-seidel
noise: true
components:
  plant: {fmu: plant.fmu, start: {mass: 0.8, psi_start: 12 deg}, tolerance: 1.0e-5}
  steps:
    block: reference
    signals:
      duty: {unit: "%", start: 6.4, changes: [{at: 0.1, to: 6.5}, {at: 0.2, to: 6.4, rate: 1}]}
      tilt: {unit: deg, start: 1}
  log: {block: playback, file: log.csv}
connections:
- {from: steps.duty, to: plant.duty_right, noise: {variance: 1.0e-6, bias: 0.01}}
- {from: steps.duty, to: plant.duty_left}
- {from: steps.tilt, to: plant.tilt_right}
record: [plant.mass, plant.*_start]
limits: {step: 5 s, total: 20, memory: 2 GB}
events: [{at: 0.1, set: {plant.tilt_left: 0.1}}]
faults:
- {on: plant.duty_right, kind: bias, value: 0.1, from: 0.1, to: 0.2}
- {on: plant.tilt_right, kind: dropout, probability: 0.5}
- {on: plant.duty_left, kind: freeze}
- {on: plant.tilt_right, kind: delay, delay: 0.04}
criteria:
  settling_time: {of: plant.psi, to: 0.2, band: 1, max: 5}
  peak: [{of: plant.psi, to: steps.tilt, after: 0.1, until: 0.3, max: 9}]
"""
DESCRIPTION = (FMU_SOURCES / "typed2.xml").read_text(encoding="utf-8")

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

NUMBERS = (0, -1, 1e-300, 1e300, 3.4e38, "1e999", "-0", "nan", "inf", "1,5", "0x1", "1_0", " 2 ", "", "٣")


@dataclass
class Found:
    """What a fuzz met."""

    count: int = 0
    wrong: list[str] = field(default_factory=list)
    longest: float = math.inf  # [s]


# -- what is changed --------------------------------------------------------------------------------


def changed(draw: Draw, data: Any) -> Any:
    """Return plain data with one to three parts replaced, removed, renamed or wrapped."""
    data = copy.deepcopy(data)
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        holders = [data]
        for holder in holders:
            parts = holder.values() if isinstance(holder, dict) else holder
            holders += [part for part in parts if isinstance(part, (dict, list)) and part]
        node, odd = draw(st.sampled_from(holders)), copy.deepcopy(draw(st.sampled_from(ODD)))
        if not node:
            return odd
        last = draw(st.sampled_from(list(node) if isinstance(node, dict) else range(len(node))))
        match draw(st.sampled_from(("replace", "replace", "remove", "rename", "wrap"))):
            case "remove":
                del node[last]
            case "rename" if isinstance(node, dict):
                node[str(odd)[:300]] = node.pop(last)
            case "wrap":
                node[last] = draw(st.sampled_from(([node[last]], {"a": node[last]}, str(node[last]))))
            case _:
                node[last] = odd
    return data


def mangled(draw: Draw, text: str, part: str = "") -> bytes:
    """Return text with a few parts, by a pattern, replaced; or pieces cut, doubled or put in; perhaps other bytes."""
    for _ in range(draw(st.sampled_from((1, 1, 2, 4)))):
        begin = draw(st.integers(0, len(text)))
        end = min(len(text), begin + draw(st.integers(0, 40)))
        new = draw(st.sampled_from((*TOKENS, *(str(odd)[:400] for odd in (*ODD, *NUMBERS)), "", text[begin:end] * 100)))
        if part and draw(st.integers(0, 3)) and (found := list(re.finditer(part, text))):
            begin, end = draw(st.sampled_from(found)).span()
            new = quoteattr(new)[1:-1] if text.startswith("<") else new
        text = text[:begin] + new + draw(st.sampled_from((text[end:], text[end:], text[begin:], "")))
    data = text.encode("utf-8", "surrogatepass")
    place = draw(st.integers(0, 16 * len(data)))
    return data[:place] + draw(st.binary(max_size=8)) + data[place:] if place <= len(data) else data


def table(rows: int = 60, step: float = 0.02) -> str:
    lines = ["time,duty_right,duty_left,tilt_right [deg],tilt_left [deg],psi [deg],psi_dot,battery [V]"]
    lines += [f"{step * k:.2f},6.4,6.4,{k % 7},{k % 5},{0.1 * k:.2f},{0.087:.3f},12" for k in range(rows)]
    return "\n".join(lines) + "\n"


# -- kinds ------------------------------------------------------------------------------------------

RUN = ("--out", "out", "--force", "--no-report")
MARKUP = r'(?<=")[^"<>]+(?=")|<[^<>?]+/>|(?<=<)[\w:]+'  # values of attributes, whole elements, tags


def scenario(draw: Draw, folder: Path) -> Iterator[list[str]]:
    path, data = folder / "case.yaml", yaml.safe_load(SCENARIO)
    if parts := draw(st.integers(0, 3)):
        data = changed(draw, data)
    text = json.dumps(data, indent=1, ensure_ascii=False)
    if draw(st.booleans()):
        with contextlib.suppress(yaml.YAMLError, UnicodeError):
            text = yaml.safe_dump(data, allow_unicode=True)
    path.write_bytes(text.encode("utf-8", "surrogatepass") if parts > 1 else mangled(draw, text))
    yield ["check", path.name]
    steps = 0
    with contextlib.suppress(CosimError):
        steps = ScenarioFile(path).scenario.steps
    if steps <= MOST_STEPS:
        yield ["run", path.name, *RUN]


def log(draw: Draw, folder: Path) -> Iterator[list[str]]:
    (folder / "case.csv").write_bytes(mangled(draw, table(draw(st.sampled_from((0, 1, 2, 3, 40, 40)))), r"[^,\n]+"))
    yield ["check", "case.csv"]


def description(draw: Draw, folder: Path) -> Iterator[list[str]]:
    path = folder / "case.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", mangled(draw, DESCRIPTION, MARKUP))
        archive.writestr("binaries/linux64/typed.so", b"\x7fELF")
    if draw(st.integers(0, 4)) == 0:  # the archive itself
        data = path.read_bytes()
        a = draw(st.integers(0, len(data)))
        path.write_bytes(data[:a] + draw(st.binary(max_size=30)) + data[a + draw(st.integers(0, 30)) :])
    yield ["check", path.name]
    content = {"name": "n", "duration": 0.1, "step": 0.05, "connections": [{"from": "r.x", "to": "m.r_in"}]}
    start = {draw(st.sampled_from(("r_in", "gain", "e_in", "s_in", "h", "z"))): draw(st.sampled_from(ODD[:20]))}
    parts = {"m": {"fmu": path.name, "start": start}, "r": {"block": "reference", "signals": {"x": {}}}}
    (folder / "with.yaml").write_text(json.dumps({**content, "components": parts}))
    yield ["run", "with.yaml", *RUN]


KINDS = {"scenario": scenario, "log": log, "description": description}


# -- what is done with it ---------------------------------------------------------------------------


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


def hold(found: Found, kind: str, root: Path, work: Path, example: Iterator[list[str]]) -> None:
    """Run the commands of an example and note their faults."""
    before = set(work.iterdir())
    for arguments in example:
        outside = everything(root, work)
        began = time.process_time()
        code, said = tried(arguments)
        took = time.process_time() - began
        reasons = [] if Path.cwd() == work.resolve() else ["another folder"]
        os.chdir(work)
        reasons += [f"says {word!r}" for word in INTERNAL if code is not None and word in said]
        left = everything(root, work) - outside
        for is_wrong, reason in (
            (code not in EXITS, f"exit {code}"),
            (took > found.longest, f"{took:.1f} s"),
            (left, f"left {', '.join(map(str, sorted(left)[:3]))}"),
        ):
            reasons += [reason] if is_wrong else []
        if reasons:
            made = [p for p in sorted(work.iterdir()) if p not in before and p.is_file()]
            files = "\n".join(f"--- {p.name}\n{p.read_bytes()[:3000]!r}" for p in made)
            found.wrong.append(f"{kind} {arguments}: {'; '.join(reasons)}\n{said[-2500:]}\n{files}")
    for path in set(work.iterdir()) - before:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    found.count += 1


def everything(root: Path, work: Path) -> set[Path]:
    """Return all files except files in output folders."""
    return {p for p in root.rglob("*") if not p.is_relative_to(work / "out")}


def fuzz(
    kind: str, count: int, number: int, folder: Path, plant: Path, most: int = 1, longest: float = math.inf
) -> Found:
    """Run `count` examples of a kind, drawn by a seed, each for at most `longest` [s]; stop after `most` faults."""
    found, work = Found(longest=longest), folder / "a" / "b" / "c" / "d"  # so that files left outside are seen
    work.mkdir(parents=True)
    (folder / "tmp").mkdir()
    shutil.copy(plant, work / "plant.fmu")
    (work / "log.csv").write_text(table(300))

    @seed(number)
    @settings(max_examples=count, deadline=None, database=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.data())
    def one(data: st.DataObject) -> None:
        if len(found.wrong) < most:
            hold(found, kind, folder, work, KINDS[kind](data.draw, work))

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
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        plant = build(plant_recipe(), Path(folder) / "plant.fmu")
        for kind in KINDS:
            found = fuzz(kind, math.ceil(total / len(KINDS)), first, Path(folder) / kind, plant, 20, LONGEST)
            print(f"{kind}: {found.count} examples, {len(found.wrong)} wrong", *found.wrong, sep="\n\n", flush=True)
            wrong += found.wrong
    print(f"seed {first}, {len(wrong)} wrong")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
