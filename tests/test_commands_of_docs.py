"""Commands that documents show: the parser accepts each, and each document is run by a test or has a reason why not."""

from __future__ import annotations

import math
import re
import shlex
import shutil
import subprocess
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import cosim
from tests.conftest import ROOT
from tests.logs import write_log
from tests.motor import motor_file, motor_log
from tests.native import NEEDS_COMPILER
from tests.test_first_steps import told
from tests.test_manners import COMMANDS

LINE = re.compile(r"(?:\S*/)?cosim (.*)")
DOCUMENTS = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("examples/**/README.md"))
}


def lines_of(document: str) -> list[str]:
    """The lines in code blocks of a document for a shell, or indented."""
    text = DOCUMENTS[document].read_text(encoding="utf-8")
    blocks = [block for kind, block in re.findall(r"```(\w*)\n(.*?)```", text, re.DOTALL) if kind in {"sh", "text", ""}]
    lines = [line for block in blocks for line in block.splitlines()] + re.findall(r"^ {4}(\S.*)$", text, re.MULTILINE)
    return [line.strip() for line in lines]


def shown(document: str) -> list[str]:
    """The commands of a document, without `cosim`."""
    return [found[1] for line in lines_of(document) if (found := LINE.fullmatch(line))]


COMMANDS_OF = {document: lines for document in DOCUMENTS if (lines := shown(document))}


@pytest.mark.parametrize("document", COMMANDS_OF)
def test_the_parser_accepts_every_command_of_a_document(document: str) -> None:
    for line in COMMANDS_OF[document]:
        words = shlex.split(re.split(r" [>|&]( |$)", line)[0], comments=True)
        if words != ["--version"]:
            COMMANDS[words[0]].make_context(words[0], words[1:])


# -- commands that are run here, with shorter times or another folder ---------------------------------------


def _of_the_craft(folder: Path) -> None:
    """FMUs and scenarios are those of `project`; logs of two seconds, one with a column of another name."""
    rows = (ROOT / "examples/hovercraft/v1.csv").read_text(encoding="utf-8").splitlines()[:101]
    (folder / "LOG.csv").write_text("\n".join([rows[0].replace("psi,", "heading [rad],", 1), *rows[1:]]) + "\n")
    shutil.copy(folder / "build" / "plant.fmu", folder / "other.fmu")
    motor_file(folder).rename(folder / "model.py")
    rows = motor_log(folder / "MOTOR.csv", 1, seconds=2.0).read_text().splitlines()
    head = rows[0].replace("time", "stamp").replace("speed", "measured_speed")
    (folder / "MOTOR.csv").write_text("\n".join([head, *rows[1:]]) + "\n")


def _of_a_cart(folder: Path) -> None:
    """A cart with mass and friction as an FMU, and logs of it."""
    (folder / "cart.py").write_text(CART, encoding="utf-8")
    cosim.build(folder, f"{folder / 'cart.py'}:Cart")
    (folder / "plant.fmu").rename(folder / "motor.fmu")
    time = np.arange(0.0, 4.0, 0.02)
    for seed, name in enumerate("abc"):
        rng = np.random.default_rng(seed)
        force, speed = np.repeat(rng.uniform(-1.0, 1.0, 10), 20), np.zeros(200)
        decay = math.exp(-0.5 / 0.8 * 0.02)
        for k in range(199):
            speed[k + 1] = decay * speed[k] + (1.0 - decay) * force[k] / 0.5
        write_log(folder / f"{name}.csv", {"time": time, "force": force, "speed": speed + rng.normal(0, 1e-3, 200)})


def _of_a_sweep(folder: Path) -> None:
    """Four runs in place of 128."""
    shutil.copytree(ROOT / "examples" / "hovercraft", folder / "examples" / "hovercraft")
    file = folder / "examples" / "hovercraft" / "sweep.yaml"
    file.write_text(file.read_text(encoding="utf-8").replace("runs: 128", "runs: 4"), encoding="utf-8")


def _refined(folder: Path) -> None:
    """What a refine leaves, for `build --model`."""
    model = folder / "results" / "refine" / "model.yaml"
    model.parent.mkdir(parents=True)
    model.write_text("schema_version: 1\nmodel: hovercraft\nparameters: {yaw_damping.coefficient: 0.006}\n")
    (model.parent / "refine.json").write_text('{"grade": "part"}')


def _clocks(folder: Path) -> None:
    shutil.copytree(ROOT / "examples" / "clocks", folder / "examples" / "clocks")


CART = '''"""A cart that a force moves against viscous friction."""

from dataclasses import dataclass

from cosim.model import Equations, Model, Namespace, Number, Quantity, Values, parameter


@dataclass(frozen=True, kw_only=True)
class Cart(Model):
    """Cart."""

    title = "cart"
    base_states = (Quantity("speed", "m/s", "speed"),)
    inputs = (Quantity("force", "N", "force"),)
    outputs = base_states
    sensor_variance = {"speed": 1e-6}
    forced = ("speed",)
    calibrated = ("mass", "friction")

    mass: float = parameter(1.0, unit="kg", bounds=(0.1, 5), doc="mass")
    friction: float = parameter(0.4, unit="N.s/m", bounds=(0.01, 5), doc="viscous friction")

    def equations(self, m: Namespace) -> Equations:
        """m·dv/dt = F − f·v."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return ((command[0] - self.friction * state[0]) / self.mass,)

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
'''
SHORT = {
    "run": ("--no-report", "--set", "duration=2", "--set", "criteria={}"),
    "replay": ("--no-report",), "sweep": ("--no-report", "--workers", "1"), "fit": ("--no-report",),
}  # fmt: skip
LONGER = [pytest.mark.thorough]
PREPARED = [
    ("docs/logs.md", _of_the_craft, LONGER),
    ("docs/times.md", lambda folder: None, ()),
    ("examples/clocks/README.md", _clocks, [NEEDS_COMPILER]),
    ("docs/ssp.md", lambda folder: None, [NEEDS_COMPILER]),
    ("docs/fit.md", _of_a_cart, LONGER),
    ("docs/probing.md", _of_a_cart, LONGER),
    ("docs/sweep.md", _of_a_sweep, LONGER),
    ("docs/native.md", _refined, [*LONGER, NEEDS_COMPILER]),
    ("docs/hosts.md", _refined, [*LONGER, NEEDS_COMPILER]),
]


@pytest.mark.parametrize(
    ("document", "prepare"),
    [pytest.param(d, p, marks=marks, id=Path(d).parent.name + Path(d).stem) for d, p, marks in PREPARED],
)
def test_the_commands_of_a_document_run_in_order(
    document: str, prepare: Callable[[Path], object], project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project)
    prepare(project)
    for line in lines_of(document):
        if "--platforms" in line:  # compiling for other systems takes minutes
            continue
        if found := LINE.fullmatch(line):
            verb, *arguments = shlex.split(found[1], comments=True)
            told(verb, *arguments, *SHORT.get(verb, ()))
        elif line.startswith("python examples/"):
            command = [sys.executable, *shlex.split(line, comments=True)[1:]]
            subprocess.run(command, check=True, capture_output=True, timeout=120)


def test_the_commands_about_results_run_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda _: True)
    signal = "{x: {start: 1, unit: m, changes: [{at: 0.5, to: 2}]}}"
    for name in ("tank", "tank", "tank", "other"):
        (tmp_path / f"{name}.yaml").write_text(
            f"name: {name}\nduration: 1\nstep: 0.1\ncomponents: {{ref: {{block: reference, signals: {signal}}}}}\n"
        )
        told("run", f"{name}.yaml", "--in-process")
    for line in COMMANDS_OF["docs/verbs.md"] + COMMANDS_OF["docs/view.md"]:
        verb, *arguments = shlex.split(line, comments=True)
        if verb in {"list", "open", "compare", "gc"} or "--prepare" in arguments:
            told(verb, *arguments)
    assert {"comparison.json", "report.html"} <= {path.name for path in tmp_path.glob("results/*/*/*")}
