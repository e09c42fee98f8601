"""Entry of the command line: `cosim` and `python -m cosim`."""

from __future__ import annotations

from cosim.base.program import as_program, ending_at_once


def main() -> None:
    """Run the command line, with an orderly exit code if it is stopped from the keyboard."""
    with ending_at_once():  # while modules are imported nothing is begun
        from cosim.verbs.cli import entry
    as_program(entry)


if __name__ == "__main__":
    main()
