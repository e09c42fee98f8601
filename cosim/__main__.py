"""Entry of the command line: `cosim` and `python -m cosim`."""

from __future__ import annotations

import os

from cosim.core.program import as_program, collect_seldom, ending_at_once


def main() -> None:
    """Run the command line, with an orderly exit code if it is stopped from the keyboard."""
    # Work side by side has threads and processes of its own; more within each wait for one another. numpy reads this
    # when it is first imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it reads all distributions in search of some
    collect_seldom()
    with ending_at_once():  # while modules are imported nothing is begun
        from cosim.verbs.cli import entry
    as_program(entry)


if __name__ == "__main__":
    main()
