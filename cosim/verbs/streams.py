"""Standard streams of a command, which may be closed before its start or by their reader."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress

import typer


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


def echo(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Write to stdout or stderr; do nothing if the reader has closed the stream."""
    try:
        typer.echo(text, err=err, nl=nl)
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # of a stream that is no file
            nobody = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nobody, (sys.stderr if err else sys.stdout).fileno())
            os.close(nobody)
