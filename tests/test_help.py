"""Help of the command line: every verb has a page with an example that its parser accepts."""

from __future__ import annotations

import inspect
import shlex

import pytest
import typer.main
from typer.testing import CliRunner

from cosim.verbs.cli import app

GROUP = typer.main.get_command(app)
COMMANDS = GROUP.commands  # type: ignore[attr-defined]


@pytest.mark.parametrize("verb", COMMANDS)
def test_a_verb_has_a_page_and_its_example_is_accepted_by_its_parser(verb: str) -> None:
    page = CliRunner().invoke(app, [verb, "-h"])
    assert page.exit_code == 0
    assert all(parameter.help for parameter in COMMANDS[verb].params)
    _, _, example = inspect.cleandoc(COMMANDS[verb].help).partition("Example: cosim ")
    name, *arguments = shlex.split(example)
    assert name == verb
    COMMANDS[verb].make_context(verb, arguments)


def test_every_verb_is_in_a_group() -> None:
    assert CliRunner().invoke(app, ["-h"]).exit_code == 0
    groups = {command.rich_help_panel for command in COMMANDS.values()}
    assert {"Simulate", "Compare and inspect", "Measured data", "Build and export"} <= groups
