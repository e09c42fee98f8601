"""Options of a command, derived from its signature and its docstring, and the live page that --live asks for.

The section `Args` of the docstring has the meaning of each parameter. In parentheses stand its metavar, and its names
on the command line if it has others: `columns (--column COLUMN=VARIABLE): Variable that a column holds.` A parameter
`**given` takes those parameters of the verb's Python function that `Args` or `MEANINGS` describes. A parameter without
a default, or with a metavar in brackets, is an argument.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from cosim.core.errors import Terminated
from cosim.core.messages import Note
from cosim.core.registry import resolve
from cosim.files.files import NOT_BLANK
from cosim.verbs.terminal import LAST, say_finding, say_note

ARGS = re.compile(r"\nArgs:\n(.*?)\n(?=\w|\Z)", re.DOTALL)
ITEM = re.compile(r"^    (\w+)(?: \((.*?)\))?: (.*?)(?=^    \w|\Z)", re.MULTILINE | re.DOTALL)
LETTERS = {"--out": "-o", "--quiet": "-q", "--verbose": "-v", "--yes": "-y"}
MEANINGS = {  # of parameters that several commands have
    "results": "Folder of results (default: results).",
    "report": "Write report.html, or do not.",
    "figures": "Write figures/*.png too.",
    "nearest": "Use nearest.yaml instead of model.yaml of every refine folder that is named.",
    "in_process": "Load FMUs into the process of the command, for a debugger; limits do not apply.",
    "compile": "Compile and execute the sources of FMUs that have no library for this machine.",
    "limits": "Limits of time and memory, for example 'step: 10 s, total: 1 h, memory: 2 GB'.",
    "format": "File format of the rows: csv, parquet, mat, hdf5, or a format of an installed package.",
    "force": "Write even if the folder is not empty; results in it are replaced.",
    "open": "Open the report in a browser.",
    "live": "Open a page that shows the work while it goes on.",
    "port": "Port of the live page (default: any free port); implies --live.",
    "json": "Print JSON instead of text.",
    "quiet": "Print only warnings, errors and JSON.",
    "verbose": "Print more, such as the order of steps and timings.",
}
PAGES = {"run": "LiveRun", "sweep": "LiveSweep", "refine": "LiveRefine"}  # verb → class of its page


def _out_path(value: Any) -> Path:
    """Refuse a blank name, which as a path would be the current folder."""
    if not str(value).strip():
        raise typer.BadParameter(f"is blank; {NOT_BLANK}")
    return Path(value)


def _seconds(text: str) -> float:
    """Return the time of an option in seconds, from a number or a time with unit like 4min."""
    try:
        return float(text)  # whether nan or inf will do is for the command to say
    except ValueError:
        pass
    from cosim.core.units import read_quantity

    try:
        return read_quantity(text, "s")
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: {error}") from None


TYPES: dict[str, Any] = {  # first type of an annotation → type of the option
    "bool": bool,
    "str": str,
    "list[str]": list[str],
    "Path": Path,
    "list[Path]": list[Path],
    "FilePath": Path,
    "ModelName": str,
    "Files": list[Path],
    "Given": list[str],
    "Names": list[str],
    "Values": list[str],
    **dict.fromkeys(("int", "Seed", "Whole", "Count", "Port"), int),
    **dict.fromkeys(("float", "Seconds", "PositiveSeconds", "Positive", "NotNegative"), float),
}
TIME: dict[str, Any] = {"parser": _seconds, "metavar": "TIME"}
SETTINGS: dict[str, dict[str, Any]] = {
    "Seconds": TIME,
    "PositiveSeconds": TIME,
    "NotNegative": {"min": 0.0},
    "Seed": {"min": 0},
    "Whole": {"min": 0},
    "Count": {"min": 1},
    "Port": {"min": 0, "max": 65535},
}


def options_of(command: Callable[..., Any], function: str) -> list[Parameter]:
    """Return the parameters of a command for Typer, with -q and -v.

    A command without `Args` in its docstring stays as it is declared.

    Args:
        function: Place of the Python function of the verb, for a command with a parameter `**given`.
    """
    own = signature(command).parameters
    manner = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=False, annotation="bool") for name in ("quiet", "verbose")
    ]
    described = ARGS.search(getdoc(command) or "")
    if described is None:
        hints = get_type_hints(command, include_extras=True)
        return [*(p.replace(annotation=hints.get(n, str)) for n, p in own.items()), *(_option(p) for p in manner)]
    items = {name: (names, meaning) for name, names, meaning in ITEM.findall(described[1])}
    shared = signature(resolve(function)).parameters if "given" in own else {}
    every = {**{n: p for n, p in shared.items() if n in items or n in MEANINGS}, **own}
    every.pop("given", None)
    return [_option(p, *items.get(p.name, ())) for p in (*every.values(), *manner)]


def _option(parameter: Parameter, names: str = "", meaning: str = "") -> Parameter:
    """Return a parameter with its annotation for Typer.

    Args:
        names: Names on the command line and metavar.
    """
    types = parameter.annotation.split(" | ")
    name = "Files" if "Files" in types else types[0]
    kind, settings = TYPES[name], {**SETTINGS.get(name, {}), "help": " ".join(meaning.split())}
    settings["help"] = settings["help"] or MEANINGS[parameter.name]
    flags = [word for word in names.split() if word.startswith("-")]
    if metavar := " ".join(word for word in names.split() if not word.startswith("-")):
        settings["metavar"] = metavar
    default = [] if parameter.default == () else parameter.default
    if not flags and parameter.name != "out" and (default is Parameter.empty or metavar.startswith("[")):
        info = typer.Argument(**settings)
    else:
        name = f"--{parameter.name.replace('_', '-')}"
        flags = flags or [f"{name}/--no-{name[2:]}" if default is True else name]
        if flags[0] == "--out":
            settings |= {"parser": _out_path, "metavar": "PATH"}
            default = None if default is Parameter.empty else default
        info = typer.Option(*flags, *([LETTERS[flags[0]]] if flags[0] in LETTERS else []), **settings)
    kind = kind | None if default is None else kind
    return Parameter(parameter.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


@contextmanager
def live_page(verb: str, title: str, *, live: bool, port: int | None, **settings: Any) -> Iterator[Any]:
    """Yield the live page of a verb, None without --live; keep it open until the user closes it."""
    if not live and port is None:
        yield None
        return
    from cosim.pages import work_pages
    from cosim.pages.server import open_page

    page = getattr(work_pages, PAGES[verb])(title, port or 0, **settings)
    LAST.append(lambda: wait_for_close(page))
    is_open = open_page(page.url, title)
    (say_note if is_open else say_finding)(Note(f"live page: {page.url}"))
    with page:
        yield page


def wait_for_close(page: Any, *limits: float) -> None:
    """Wait until the user closes a page; the exit code is that of the work."""
    with suppress(KeyboardInterrupt, Terminated):
        page.wait_for_close(say_note, *limits)
