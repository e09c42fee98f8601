"""`cosim` as a command, also `python -m cosim`."""

from __future__ import annotations

from cosim.base.program import as_program, ending_at_once


def main() -> None:
    """Console entry."""
    with ending_at_once():  # while modules are imported nothing is begun
        from cosim.verbs.cli import entry
    as_program(entry)


if __name__ == "__main__":
    main()
