"""What the documents show is executed: snippets, the notebook, the effect of CONTRIBUTING; what they name exists."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import ModuleType

import pytest
import typer.main

from cosim.verbs.cli import command_line
from tests.conftest import ROOT
from tests.test_examples_data import _loaded

README = (ROOT / "README.md").read_text()
HOSTS = (ROOT / "docs" / "hosts.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README + HOSTS, re.DOTALL)


def run_python(code: str, folder: Path, **variables: str) -> str:
    """What Python prints, run in a folder with further variables of the environment."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=folder, env={**os.environ, **variables},
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.thorough
@pytest.mark.hosts
@pytest.mark.parametrize("snippet", SNIPPETS, ids=lambda s: s.split()[1].split(".")[0])
def test_a_snippet_for_another_host_runs_and_the_craft_moves_forward(project: Path, snippet: str) -> None:
    package = snippet.split()[1].split(".")[0]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    library = Path(sysconfig.get_paths()["data"]) / "lib"
    done = run_python(snippet, project, LD_LIBRARY_PATH=f"{library}:{os.environ.get('LD_LIBRARY_PATH', '')}")
    # both propellers, or the right one alone, tilted 0.05 rad for 2 s: a few tenths of a metre
    (x,) = (float(line) for line in done.splitlines() if re.fullmatch(r"[-\d.e]+", line))  # beside a host's log
    assert 0.1 < x < 1.0


def test_the_effect_of_contributing_works_as_shown() -> None:
    block = re.search(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    assert block is not None
    imports = "from plant.effects import REST, HovercraftEffect, Motion\nfrom cosim.model import SCALAR, size\n"
    scope: dict[str, object] = {}
    exec(imports + "\n".join(line.removeprefix("   ") for line in block[1].splitlines()), scope)
    kind = scope["SidewaysDrag"]
    motion = scope["Motion"](1.0, -0.5, 0.0, 0.0, 0.0)  # type: ignore[operator]
    force = kind(coefficient=2.0).wrench(scope["SCALAR"], motion)  # type: ignore[operator]
    assert force == pytest.approx((0.0, 0.5, 0.0, 0.0))  # −2·0.5·(−0.5) N
    assert kind().dormant  # type: ignore[operator]


@pytest.mark.thorough
def test_the_notebook_runs(tmp_path: Path) -> None:
    pytest.importorskip("nbclient", reason="no nbclient")
    pytest.importorskip("ipykernel", reason="no ipykernel")
    for name in ("tank.py", "level_control.py", "tanks.ipynb"):
        shutil.copy(ROOT / "examples" / "tanks" / name, tmp_path)
    code = (
        "import nbformat, nbclient\n"
        "nb = nbclient.NotebookClient(nbformat.read('tanks.ipynb', 4), timeout=60, kernel_name='python3').execute()\n"
        "print([o.get('data', {}).get('text/plain', '') for c in nb.cells for o in c.get('outputs', [])][-1])"
    )
    done = run_python(code, tmp_path, PYTHONPATH=str(ROOT), PYDEVD_DISABLE_FILE_VALIDATION="1")
    assert "4 of 5 " in done  # signals that differ; the reference is the same
    assert len(done) < 1500  # a result shows itself in a few lines


def script_of_docs(name: str) -> ModuleType:
    """A module in docs/."""
    return _loaded(ROOT / "docs" / f"{name}.py")


def test_the_reference_of_the_command_line_has_every_verb_and_option() -> None:
    sections = re.split(r"^### ", script_of_docs("reference").format_command_line(), flags=re.MULTILINE)[1:]
    text_of = {section.split("\n")[0]: section for section in sections}
    commands = typer.main.get_command(command_line()).commands  # type: ignore[attr-defined]
    assert set(text_of) == set(commands)
    for name, command in commands.items():
        for parameter in command.params:
            assert parameter.help.rstrip(".").replace("|", "\\|") in text_of[name], (name, parameter.name)


DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]


def test_links_between_documents_lead_somewhere() -> None:
    for document in DOCUMENTS:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_tests_that_documents_name_exist() -> None:
    names = {
        path.stem: re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE)
        for path in (ROOT / "tests").glob("test_*.py")
    }
    for document in DOCUMENTS:
        text = document.read_text()
        wanted = [(file, name) for file, name in re.findall(r"\b(test_\w+)(?:\.py)?::(test_\w+)", text)]
        for file, quoted, word in re.findall(r"pytest(?: tests/(test_\w+)\.py)?(?: -k (?:\"(.+?)\"|(\w+)))?", text):
            wanted += [(file, part) for part in re.split(r" (?:or|and) ", quoted or word)]
        modules = re.findall(r"python -m (tests\.\w+)", text)
        assert [m for m in modules if importlib.util.find_spec(m) is None] == [], document.name
        for file, part in wanted:
            known = [f"{stem} {name}" for stem in names if file in {"", stem} for name in names[stem]]
            assert any(part in entry for entry in known), f"{document.name}: {file} {part}"
