"""Help pages of the command line: verbs in groups, options with placeholders and defaults, whole sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

WHOLE_WIDTH = 10_000  # columns: help is as wide as the terminal
PLAIN: dict[Any, Callable[[Any], Any]] = {str: str, Path: Path, list[str]: list}  # types to convert without Typer
CHECKS = (
    "parser",
    "click_type",
    "exists",
    "writable",
    "resolve_path",
    "allow_dash",
    "path_type",
)  # what Typer does more
OTHERS = "Other packages"  # group of verbs that name none


class VerbHelp(TyperCommand):
    """Help of one verb, and its command line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse a command line without its omitted optional parameters."""
        for parameter in self.params:
            _convert_plainly(parameter)
        with _without_omitted(self, ctx, args, _stays_none):
            return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words after the name of the verb."""
        return ["[OPTIONS]", *(format_placeholder(p) for p in self.params if p.param_type_name == "argument")]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options."""
        _write_parameters(self, ctx, formatter)


class GroupedHelp(TyperGroup):
    """Help of `cosim`: its options and its verbs, one section per group."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse a command line without its omitted options; those of Typer for completions do nothing without value."""
        with _without_omitted(self, ctx, args, lambda p: p.default is None):
            return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options and the groups of verbs."""
        _write_parameters(self, ctx, formatter)
        groups: dict[str, list[tuple[str, str]]] = {}
        width = max(map(len, self.commands), default=0)
        for name, command in self.commands.items():
            first_line = (command.help or "").split("\n", 1)[0]
            groups.setdefault(_get_group(command), []).append((name.ljust(width), first_line))
        for title, rows in groups.items():
            with formatter.section(title):
                formatter.write_dl(rows)


def format_placeholder(parameter: Any) -> str:
    """Return the placeholder for the value of an argument or option: FILE, INTEGER; "" for a switch."""
    if getattr(parameter, "is_flag", False) or getattr(parameter, "count", False):
        return ""
    word = str(parameter.metavar or parameter.name.strip("_").upper())
    return f"{word}..." if parameter.param_type_name == "argument" and parameter.nargs != 1 else word


def format_description(parameter: Any) -> str:
    """Return the help of an argument or option, with its default value and a note if repeatable."""
    text = (parameter.help or "").rstrip(".")
    default = parameter.default
    if isinstance(default, bool):
        default = parameter.opts[0] if default else None
    elif parameter.param_type_name == "argument" or callable(default):
        default = None
    text += f" (default: {default})" if default not in (None, "") else ""
    return f"{text}." + (" Repeatable." if getattr(parameter, "multiple", False) else "")


def format_names(parameter: Any) -> str:
    """Return the spellings of an option, short ones first, and its placeholder."""
    options = ", ".join(sorted(parameter.opts, key=len))
    spellings = [" / ".join([options, *parameter.secondary_opts]), format_placeholder(parameter)]
    return (
        format_placeholder(parameter) if parameter.param_type_name == "argument" else " ".join(filter(None, spellings))
    )


@contextmanager
def _without_omitted(
    command: TyperCommand | TyperGroup, ctx: Any, args: list[str], may_omit: Callable[[Any], bool]
) -> Iterator[None]:
    """Hide parameters without value: Typer would convert None, for which it imports pydantic."""
    values, _, _ = command.make_parser(ctx).parse_args(args=[*args])
    given = {name for name, value in values.items() if value not in (None, ())}
    every, has_help = command.params, command.add_help_option
    if "help" not in given:  # which lists all parameters
        command.params = [p for p in every if p.name in given or not may_omit(p)]
        command.add_help_option = False
    try:
        yield
    finally:
        command.params, command.add_help_option = every, has_help


def _convert_plainly(parameter: Any) -> None:
    """Let a parameter convert texts and paths by itself: Typer imports pydantic for that."""
    about = getattr(parameter, "type_descriptor", None)  # of later versions of Typer
    convert = PLAIN.get(getattr(about, "annotation", None))
    if convert is None or parameter.callback or "process_value" in vars(parameter):
        return
    if any(getattr(about.parameter_info, key, None) for key in CHECKS):  # type: ignore[union-attr]
        return
    typer_converts = parameter.process_value
    parameter.process_value = lambda ctx, value: convert(value) if value else typer_converts(ctx, value)


def _stays_none(parameter: Any) -> bool:
    """Return whether a parameter is None if the command line omits it."""
    others = (parameter.required, parameter.default is not None, parameter.envvar, parameter.callback)
    return not any(others) and not getattr(parameter, "prompt", None)


def _get_group(command: Any) -> str:
    group = getattr(command, "rich_help_panel", None)
    return group if isinstance(group, str) and group else OTHERS


def _write_parameters(command: Any, ctx: typer.Context, formatter: Any) -> None:
    rows: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
    for parameter in command.get_params(ctx):
        if not getattr(parameter, "hidden", False):
            title = "Arguments" if parameter.param_type_name == "argument" else "Options"
            rows[title].append((format_names(parameter), format_description(parameter)))
    for title, records in rows.items():
        if records:
            with formatter.section(title):
                formatter.write_dl(records)
