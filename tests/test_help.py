"""Help of the command line: groups, whole sentences, placeholders, examples that the parser accepts."""

from __future__ import annotations

import re
import shlex

import pytest
import typer.main
from typer.testing import CliRunner

from cosim.fmi.native.platforms import PLATFORMS
from cosim.verbs.cli import app

GROUP = typer.main.get_command(app)
COMMANDS = GROUP.commands  # type: ignore[attr-defined]
GROUPS = ["Simulate", "Compare and inspect", "Measured data", "Build and export"]


def help_page(*words: str, columns: int = 80) -> str:
    """Help on a terminal of this width."""
    done = CliRunner().invoke(app, [*words, "-h"], terminal_width=columns, env={"COLUMNS": str(columns)})
    assert done.exit_code == 0
    return done.output


def test_verbs_are_listed_in_groups_with_a_whole_sentence_each() -> None:
    page = help_page(columns=200)
    titles = re.findall(r"^([A-Z][a-z ]+):$", page, re.MULTILINE)
    assert titles[:5] == ["Options", *GROUPS]
    for name, command in COMMANDS.items():
        (line,) = re.findall(rf"^  {name}  +(.+)$", page, re.MULTILINE)
        assert line == command.help.split("\n")[0]
        assert line.endswith(".")


def test_a_verb_of_another_package_names_its_group() -> None:
    if "identify" not in COMMANDS:
        pytest.skip("the worked example is not installed")
    assert re.search(r"^Craft example:\n  identify ", help_page(), re.MULTILINE)


@pytest.mark.parametrize("verb", COMMANDS)
def test_the_help_of_a_verb_has_sentences_and_placeholders_and_fits_the_terminal(verb: str) -> None:
    narrow, wide = help_page(verb), help_page(verb, columns=160)
    assert not re.search(r"…|<\w|[a-z]\.\.\.|\[default|\[required", narrow)  # FILE... is a placeholder
    assert max(map(len, narrow.splitlines())) <= 80
    assert max(map(len, wide.splitlines())) <= 160
    assert len(wide.splitlines()) < len(narrow.splitlines()) or max(map(len, narrow.splitlines())) < 78
    for parameter in COMMANDS[verb].params:
        assert re.fullmatch(r"[A-Z].*\.", parameter.help), parameter.name


@pytest.mark.parametrize("verb", COMMANDS)
def test_the_example_of_a_verb_is_accepted_by_its_parser(verb: str) -> None:
    (example,) = re.findall(r"^  Example: cosim (.+)$", help_page(verb), re.MULTILINE)
    name, *arguments = shlex.split(example)
    assert name == verb
    COMMANDS[verb].make_context(verb, arguments)


def test_placeholders_defaults_and_repeated_options_are_in_words() -> None:
    sweep = help_page("sweep", columns=160)
    assert re.search(r"--workers INTEGER +Number of worker processes \(default: one per core\)\.\n", sweep)
    run = help_page("run", columns=160)
    assert re.search(r"--seed INTEGER +Seed for all random numbers \(default: the seed of the scenario\)\.\n", run)
    assert re.search(r"--set PATH=VALUE +Replace a value of the scenario, for example noise=off\. Repeatable\.\n", run)
    assert "(default: csv)" in run


def test_platforms_are_those_that_are_declared() -> None:
    page = help_page("build", columns=300)
    assert all(name in page for name in PLATFORMS)
