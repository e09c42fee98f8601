"""`python -m tests.foreign_linear FOLDER`: `cosim linearize` of every FMU for model exchange there, a line each."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from cosim.base.errors import CosimError
from cosim.blocks.description import read_description, ways
from cosim.blocks.summary import summary_of
from cosim.linearization.workflow import linearize


def main(folder: Path) -> int:
    """Print the result of each FMU, and counts; return 1 if an FMU fails."""
    counts: Counter[str] = Counter()
    for path in sorted(folder.rglob("*.fmu")):
        try:
            description = read_description(path)
        except CosimError:
            counts["cannot be read"] += 1
            continue
        if "model-exchange" not in ways(description):
            counts["for co-simulation alone"] += 1
            continue
        if not summary_of(path, description).runs_here:
            counts["without a library for this machine"] += 1
            continue
        try:
            outcome = linearize(path)
        except CosimError as error:
            counts["fails"] += 1
            print(f"{path.name}: {error}")
            continue
        m = outcome.first
        counts["linearised"] += 1
        print(f"{path.name}: {len(m.states)} states, {len(m.inputs)} inputs, {len(m.outputs)} outputs, by {m.method}")
        print("".join(f"    {note}\n" for note in outcome.notes), end="")
    print(", ".join(f"{n} {what}" for what, n in counts.items()))
    return int(counts["fails"] > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
