"""What the documents show is executed: commands, snippets, the effect of CONTRIBUTING, the effects' table."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from itertools import chain
from pathlib import Path
from types import ModuleType

import pytest
import typer.main

from cosim.estimation.subject.model_subject import ModelSubject
from cosim.fmi.fmu_build import build
from cosim.verbs import verbs
from cosim.verbs.cli import command_line
from fmus.recipes import plant_recipe
from plant.hovercraft import Hovercraft
from tests.test_first_steps import told
from tests.warm import cosim

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
HOSTS = (ROOT / "docs" / "hosts.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README + HOSTS, re.DOTALL)
COMMANDS = re.findall(r"^\.venv/bin/cosim (.*?)(?:\s+#.*)?$", README, re.MULTILINE)


@pytest.mark.thorough
@pytest.mark.hosts
@pytest.mark.parametrize("snippet", SNIPPETS, ids=lambda s: s.split()[1].split(".")[0])
def test_a_snippet_for_another_host_runs_and_the_craft_moves_forward(project: Path, snippet: str) -> None:
    package = snippet.split()[1].split(".")[0]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    library = Path(sysconfig.get_paths()["data"]) / "lib"
    environment = {**os.environ, "LD_LIBRARY_PATH": f"{library}:{os.environ.get('LD_LIBRARY_PATH', '')}"}
    done = subprocess.run(
        [sys.executable, "-c", snippet], cwd=project, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    # both propellers, or the right one alone, tilted 0.05 rad for 2 s: a few tenths of a metre
    (x,) = (float(line) for line in done.stdout.splitlines() if re.fullmatch(r"[-\d.e]+", line))  # beside a host's log
    assert 0.1 < x < 1.0


@pytest.mark.thorough
def test_the_commands_of_the_readme_run_in_order(project: Path) -> None:
    shutil.copytree(ROOT / "examples" / "hovercraft", project / "examples" / "hovercraft")
    assert {command.split()[0] for command in COMMANDS} <= {name for name, verb in verbs() if verb.command}
    refined = project / "results" / "study" / "0001" / "model.yaml"  # as `make refine` leaves it
    refined.parent.mkdir(parents=True)
    found = "{yaw_damping.coefficient: 0.006, coulomb_friction.force: 0.05}"
    refined.write_text(f"schema_version: 1\nmodel: hovercraft\nparameters: {found}\n")
    (refined.parent / "refine.json").write_text("{}")
    quick = [command for command in COMMANDS if not command.startswith("excite")]  # tests/test_excite.py has it
    assert quick
    for command in quick:
        words = [sorted(project.glob(word)) or [word] if "*" in word else [word] for word in shlex.split(command)]
        done = cosim(*chain.from_iterable(words), cwd=project)
        assert done.returncode == 0, (command, done.stderr)
    first, _, again = [path.read_bytes() for path in sorted(project.glob("results/regulate/*/results.csv"))][:3]
    assert first == again


def command(project: Path, line: str) -> subprocess.CompletedProcess[str]:
    """A command as a document shows it."""
    return cosim(*shlex.split(line, comments=True)[1:], cwd=project)


def refined_craft(folder: Path) -> None:
    """What a refine leaves that claims yaw damping and dry friction, and would go further in its nearest model."""
    folder.mkdir(parents=True)
    found = {"yaw_damping.coefficient": 0.006, "coulomb_friction.force": 0.05}
    for name, values in (("model.yaml", found), ("nearest.yaml", {**found, "friction": 0.26})):
        given = "".join(f"  {key}: {value}\n" for key, value in values.items())
        (folder / name).write_text(f"schema_version: 1\nmodel: hovercraft\nparameters:\n{given}")
        build(plant_recipe(values), folder / {"model.yaml": "plant.fmu"}.get(name, "nearest.fmu"))
    (folder / "refine.json").write_text('{"grade": "part"}')


@pytest.mark.thorough
def test_the_recipes_for_a_refined_model_run_and_overwrite_no_fmu_of_a_scenario(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refined_craft(project / "refined")
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "docs" / "refined.md").read_text(), re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("cosim ")]
    assert [line.split()[1] for line in lines] == ["run", "build", "run", "excite", "build", "run"]
    before = (project / "build" / "plant.fmu").read_bytes()
    shutil.copytree(ROOT / "examples" / "hovercraft", project / "examples" / "hovercraft")
    monkeypatch.chdir(project)
    short = ["--no-report", "--set", "duration=1", "--set", "criteria={}"]
    for line in lines:
        if "excite" not in line:  # tests/test_excite.py has it
            arguments = shlex.split(line, comments=True)[1:]
            command_line()([*arguments, *(short if "run" in arguments else ())], standalone_mode=False)
    assert (project / "build" / "plant.fmu").read_bytes() == before


@pytest.mark.thorough
def test_a_controller_designed_for_a_refined_craft_meets_all_criteria_of_the_manoeuvre(project: Path) -> None:
    refined_craft(project / "re fined")
    design = ROOT / "examples" / "hovercraft" / "design.yaml"
    done = cosim("build", "--model", "re fined", "--design", design, "--out", "built", cwd=project)
    assert done.returncode == 0, done.stderr
    line = shlex.join(ModelSubject.of(Hovercraft()).use(project / "re fined")).replace(
        "scenario.yaml", "scenarios/manoeuvre.yaml"
    )
    done = command(project, f"{line} --set components.controller.fmu=built/controller.fmu")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("met: ") == 6


def test_the_effect_of_contributing_works_as_shown() -> None:
    block = re.search(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    assert block is not None
    imports = (
        "from dataclasses import dataclass\nfrom plant.effects import REST\n"
        "from plant.effects import HovercraftEffect, Motion, Wrench\n"
        "from cosim.model.namespaces import SCALAR, Namespace\nfrom cosim.model.quantities import parameter\n"
    )
    scope: dict[str, object] = {}
    exec(imports + "\n".join(line.removeprefix("   ") for line in block[1].splitlines()), scope)
    kind = scope["SidewaysDrag"]
    motion = scope["Motion"](1.0, -0.5, 0.0, 0.0, 0.0)  # type: ignore[operator]
    force = kind(coefficient=2.0).wrench(scope["SCALAR"], motion)  # type: ignore[operator]
    assert force == pytest.approx((0.0, 0.5, 0.0, 0.0))  # −2·0.5·(−0.5) N
    assert kind().dormant  # type: ignore[operator]


def typed(document: str) -> list[str]:
    """The commands of a document, in order."""
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "docs" / document).read_text(), re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("document", "says"),
    [
        ("my_fmus.md", "1 of 1 criteria missed"),
        ("my_log.md", "The model lacks leak (rate = 0.01"),
    ],
)
def test_the_commands_of_a_tutorial_run_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, document: str, says: str
) -> None:
    ignored = shutil.ignore_patterns("*.csv")
    shutil.copytree(ROOT / "examples" / "tanks", tmp_path / "examples" / "tanks", ignore=ignored)
    monkeypatch.chdir(tmp_path)
    others = {"python": [], "pythonfmu": ["-c", "from pythonfmu.__main__ import cli_main; cli_main()"]}
    answers = []
    for line in typed(document):
        name, *arguments = shlex.split(line, comments=True)
        if name == "cosim":
            code = re.search(r"# exit code (\d+)", line)
            short = (
                ["--no-report"] if arguments[0] in {"run", "replay", "refine", "compare"} else []
            )  # `make docs` draws
            answers.append(told(*arguments, *short, code=int(code[1]) if code else 0))
        else:
            command = [sys.executable, "-W", "ignore", *others[name], *arguments]
            subprocess.run(command, capture_output=True, check=True, timeout=120)
    assert any(says in answer for answer in answers)
    shown = re.findall(r"```yaml\n(connections:.*?)```", (ROOT / "docs" / document).read_text(), re.DOTALL)
    assert all(block in (tmp_path / "tanks.yaml").read_text() for block in shown)


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
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYDEVD_DISABLE_FILE_VALIDATION": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "4 of 5 signals are beyond the tolerance" in done.stdout
    assert len(done.stdout) < 1500  # a result shows itself in a few lines


def script_of_docs(name: str) -> ModuleType:
    """A module in docs/."""
    spec = importlib.util.spec_from_file_location(f"{name}_of_docs", ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_of_the_command_line_has_every_verb_and_option() -> None:
    sections = re.split(r"^### ", script_of_docs("reference").format_command_line(), flags=re.MULTILINE)[1:]
    text_of = {section.split("\n")[0]: section for section in sections}
    commands = typer.main.get_command(command_line()).commands  # type: ignore[attr-defined]
    assert set(text_of) == set(commands)
    for name, command in commands.items():
        for parameter in command.params:
            assert parameter.help.rstrip(".").replace("|", "\\|") in text_of[name], (name, parameter.name)


def test_links_between_documents_lead_somewhere() -> None:
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_tests_that_documents_name_exist() -> None:
    names = {
        path.stem: re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE)
        for path in (ROOT / "tests").glob("test_*.py")
    }
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        text = document.read_text()
        wanted = [(file, name) for file, name in re.findall(r"\b(test_\w+)(?:\.py)?::(test_\w+)", text)]
        for file, quoted, word in re.findall(r"pytest(?: tests/(test_\w+)\.py)?(?: -k (?:\"(.+?)\"|(\w+)))?", text):
            wanted += [(file, part) for part in re.split(r" (?:or|and) ", quoted or word)]
        modules = re.findall(r"python -m (tests\.\w+)", text)
        assert [m for m in modules if importlib.util.find_spec(m) is None] == [], document.name
        for file, part in wanted:
            known = [f"{stem} {name}" for stem in names if file in {"", stem} for name in names[stem]]
            assert any(part in entry for entry in known), f"{document.name}: {file} {part}"
