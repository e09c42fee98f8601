"""Commands that documents show: the parser accepts each, and each document is run by a test or has a reason why not."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.fmi.fmu_build import build
from fmus.recipes import plant_recipe
from tests.conftest import ROOT
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


def _of_a_sweep(folder: Path) -> None:
    """Four runs in place of 128."""
    _example("hovercraft")(folder)
    file = folder / "examples" / "hovercraft" / "sweep.yaml"
    file.write_text(file.read_text(encoding="utf-8").replace("runs: 128", "runs: 4"), encoding="utf-8")


def _refined(folder: Path, place: str = "results/refine") -> None:
    """What a refine leaves, for `build --model`."""
    model = folder / place / "model.yaml"
    model.parent.mkdir(parents=True)
    model.write_text("schema_version: 1\nmodel: hovercraft\nparameters: {yaw_damping.coefficient: 0.006}\n")
    (model.parent / "refine.json").write_text('{"grade": "part"}')


def _example(name: str) -> Callable[[Path], object]:
    ignored = shutil.ignore_patterns("*.csv") if name == "tanks" else None
    return lambda folder: shutil.copytree(ROOT / "examples" / name, folder / "examples" / name, ignore=ignored)


def _of_the_readme(folder: Path) -> None:
    _example("hovercraft")(folder)
    _refined(folder, "results/study/0001")


def _refined_further(folder: Path) -> None:
    """What a refine leaves that would go further in its nearest model."""
    _example("hovercraft")(folder)
    _refined(folder, "refined")
    (folder / "refined" / "nearest.yaml").write_text(
        "schema_version: 1\nmodel: hovercraft\nparameters: {friction: 0.26}\n"
    )
    build(plant_recipe({"yaw_damping.coefficient": 0.006}), folder / "refined" / "plant.fmu")
    build(plant_recipe({"friction": 0.26}), folder / "refined" / "nearest.fmu")


PYTHON = {"python": [], "pythonfmu": ["-c", "from pythonfmu.__main__ import cli_main; cli_main()"]}
SAYS = {
    "docs/my_fmus.md": "1 of 1 criteria missed", "docs/trust.md": "1 of 1 criteria missed",
    "docs/my_log.md": "The model lacks leak (rate = 0.01",
}  # fmt: skip
SHORT = {
    "run": ("--no-report", "--set", "duration=2", "--set", "criteria={}"),
    "replay": ("--no-report",), "sweep": ("--no-report", "--workers", "1"),
}  # fmt: skip
LONGER = [pytest.mark.thorough]
PREPARED = [
    ("docs/times.md", lambda folder: None, ()),
    ("examples/clocks/README.md", _example("clocks"), [NEEDS_COMPILER]),
    ("docs/ssp.md", lambda folder: None, [NEEDS_COMPILER]),
    ("docs/sweep.md", _of_a_sweep, LONGER),
    ("docs/native.md", _refined, [*LONGER, NEEDS_COMPILER]),
    ("docs/hosts.md", _refined, [*LONGER, NEEDS_COMPILER]),
    ("README.md", _of_the_readme, LONGER),
    ("docs/refined.md", _refined_further, LONGER),
    ("docs/my_fmus.md", _example("tanks"), LONGER),
    ("docs/my_log.md", _example("tanks"), LONGER),
    ("docs/trust.md", _example("tanks"), LONGER),
]


def expanded(word: str, folder: Path) -> list[Path] | list[str]:
    """A word as a shell passes it."""
    return (sorted(folder.glob(word)) if "*" in word else []) or [word]


@pytest.mark.parametrize(
    ("document", "prepare"),
    [pytest.param(d, p, marks=marks, id=Path(d).parent.name + Path(d).stem) for d, p, marks in PREPARED],
)
def test_the_commands_of_a_document_run_in_order(
    document: str, prepare: Callable[[Path], object], project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project)
    prepare(project)
    before, answers = (project / "build" / "plant.fmu").read_bytes(), []
    for line in lines_of(document):
        if "--platforms" in line:  # compiling for other systems takes minutes
            continue
        if found := LINE.fullmatch(line):
            verb, *arguments = shlex.split(found[1], comments=True)
            arguments = [str(each) for word in arguments for each in expanded(word, project)]
            code = re.search(r"# exit code (\d+):", line)
            short: tuple[str, ...] = SHORT.get(verb, ())
            if document in SAYS:
                short = ("--no-report",) if verb in {"run", "replay", "refine", "compare"} else ()  # `make docs` draws
            if verb != "excite":  # tests/test_excite.py has it
                answers.append(told(verb, *arguments, *short, code=int(code[1]) if code else 0))
        elif line.startswith(("python examples/", "pythonfmu build")):
            name, *words = shlex.split(line, comments=True)
            command = [sys.executable, "-W", "ignore", *PYTHON[name], *words]
            subprocess.run(command, check=True, capture_output=True, timeout=120)
    assert any(SAYS.get(document, "") in answer for answer in answers)
    if document == "docs/refined.md":
        assert (project / "build" / "plant.fmu").read_bytes() == before
