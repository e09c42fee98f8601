"""Standard streams of a command, which may be closed before its start or by their reader."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress

import typer

from cosim.base.messages import printable


def open_streams() -> None:
    """Open /dev/null for each closed standard stream; otherwise a file opened later would take its number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)  # the least number that is free
            if getattr(sys, name) is None and opened == number:
                setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal or file that is not UTF-8 has no true minus sign
            stream.reconfigure(errors="backslashreplace")


class Coloured(str):
    """A line with a colour."""

    colour: str

    def __new__(cls, text: str, colour: str) -> Coloured:
        """Return a line of a text."""
        line = super().__new__(cls, text)
        line.colour = colour
        return line


def echo(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Write to stdout or stderr without control characters; do nothing if the reader has closed the stream."""
    shown = printable(text)
    if isinstance(text, Coloured):
        shown = typer.style(shown, fg=text.colour)
    try:
        typer.echo(shown, err=err, nl=nl)
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # of a stream that is no file
            nobody = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nobody, (sys.stderr if err else sys.stdout).fileno())
            os.close(nobody)
