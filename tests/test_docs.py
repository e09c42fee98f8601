"""What the documents show is executed: README commands and snippets, the effect of CONTRIBUTING, the effects' table."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from plant.effects import CATALOGUE
from plant.quantities import parameters_of

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
COMMANDS = re.findall(r"^\.venv/bin/cosim (.*?)(?:\s+#.*)?$", README, re.MULTILINE)


@pytest.mark.hosts
@pytest.mark.parametrize("snippet", SNIPPETS, ids=lambda s: s.split()[1].split(".")[0])
def test_a_snippet_of_the_readme_runs_and_the_craft_moves_forward(project: Path, snippet: str) -> None:
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


def test_the_commands_of_the_readme_run_in_order(project: Path) -> None:
    shutil.copytree(ROOT / "examples" / "hovercraft", project / "examples" / "hovercraft")
    verbs = ["build", "run", "run", "run", "check", "check", "replay", "build", "run", "excite"]
    assert [command.split()[0] for command in COMMANDS] == verbs
    refined = project / "results" / "refine" / "model.yaml"  # as `make refine` leaves it
    refined.parent.mkdir(parents=True)
    found = "{yaw_damping.coefficient: 0.006, coulomb_friction.force: 0.05}"
    refined.write_text(f"schema_version: 1\nmodel: hovercraft\nparameters: {found}\n")
    for command in COMMANDS[:-1]:  # the flight of excite takes its time; tests/test_excite.py has it
        done = subprocess.run(
            f"{sys.executable} -m cosim.cli {command}", shell=True, cwd=project, capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, (command, done.stderr)
        if command.startswith("run") and "--out again" in command:
            results = [project / folder / "results.csv" for folder in ("results", "again")]
            assert results[0].read_bytes() == results[1].read_bytes()


def test_the_scenario_of_the_readme_is_part_of_the_one_we_ship() -> None:
    block = re.search(r"```yaml\n(.*?)```", README, re.DOTALL)
    assert block is not None
    shipped = (ROOT / "scenarios" / "regulate.yaml").read_text()
    for word in re.findall(r"from: (\S+),", block[1]) + re.findall(r"(\w+):", block[1]):
        assert word in shipped or word in {"algorithm", "criteria"}, word


def test_the_effect_of_contributing_works_as_shown() -> None:
    block = re.search(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    assert block is not None
    imports = (
        "from dataclasses import dataclass\nfrom plant.effects.friction import REST\n"
        "from plant.effects.terms import HovercraftEffect, Motion, Wrench\n"
        "from plant.namespaces import SCALAR, Namespace\nfrom plant.quantities import parameter\n"
    )
    scope: dict[str, object] = {}
    exec(imports + "\n".join(line.removeprefix("   ") for line in block[1].splitlines()), scope)
    kind = scope["SidewaysDrag"]
    motion = scope["Motion"](1.0, -0.5, 0.0, 0.0, 0.0)  # type: ignore[operator]
    force = kind(coefficient=2.0).wrench(scope["SCALAR"], motion)  # type: ignore[operator]
    assert force == pytest.approx((0.0, 0.5, 0.0, 0.0))  # −2·0.5·(−0.5) N
    assert kind().dormant  # type: ignore[operator]


def test_the_document_of_the_model_lists_every_effect_as_declared() -> None:
    text = (ROOT / "docs" / "model.md").read_text()
    for kind in CATALOGUE:
        row = next(line for line in text.splitlines() if line.startswith(f"| `{kind.name}` |"))
        assert kind.equation.replace("|", "\\|") in row
        for p in parameters_of(kind):
            assert f"`{p.name}` [{p.unit}] {p.default:g}" in row


def test_links_between_documents_lead_somewhere() -> None:
    for document in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name}: {target}"
