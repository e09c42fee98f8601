"""`python -m tests.known` prints docs/known.md; `--fmpy` what FMPy's `simulate_fmu` makes of the cases of one FMU."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from tests.known.cases import CASES
from tests.known.table import KINDS, Case

HEAD = """# Known answers

The numbers of these systems are known without a simulator: from a formula, a sentence of a standard, or another
integrator at a tolerance of 1e-12. `tests/test_known.py` runs each of them. `tests/known/` has the equations, scenarios
and tolerances. `python -m tests.known > docs/known.md` writes this page.

FMPy is not the answer. `python -m tests.known --fmpy` runs the cases of a single FMU by its `simulate_fmu`. Where its
number differs, the last column says which one it is, and who is right. An empty cell: several FMUs, or a key of cosim.
"""
TABLE = "\n## {title}\n\n| case | system | right value and its source | FMPy 0.3.32 |\n|---|---|---|---|\n"


def page() -> str:
    """Return docs/known.md."""
    parts = [HEAD]
    for kind in KINDS:
        rows = [case for case in CASES if case.kind == kind]
        parts.append(TABLE.format(title=kind[0].upper() + kind[1:]))
        parts += [f"| {' | '.join(_cells(case))} |\n" for case in rows]
    parts.append(f"\n{len(CASES)} systems, {sum(len(case.runs) for case in CASES)} runs.\n")
    return "".join(parts)


def _cells(case: Case) -> Iterator[str]:
    peer = case.differs or ("same" if case.peer else "")
    yield from (f"`{case.name}`", *(text.replace("|", "\\|") for text in (case.system, case.source, peer)))


def measure() -> None:
    """Print the right numbers beside those of FMPy."""
    import fmpy

    for case in CASES:
        if case.peer is None:
            continue
        names = {a.signal.partition(".")[2] for a in case.answers if "." in a.signal}
        try:
            rows = fmpy.simulate_fmu(str(case.peer.fmu()), output=sorted(names), **case.peer.arguments)
        except Exception as error:
            print(f"{case.name}: {type(error).__name__}: {error}")
            continue
        begin = float(case.peer.arguments.get("start_time", 0))
        for answer in case.answers:
            name = answer.signal.partition(".")[2]
            if name not in rows.dtype.names:
                print(f"{case.name}: no {answer.signal}; last row {rows[-1]}")
                continue
            wanted = answer.value() if callable(answer.value) else answer.value
            time = rows["time"][-1] if answer.time is None else answer.time
            right = np.ravel(wanted)[-1]
            value = rows[name][np.argmin(np.abs(rows["time"] - time))]
            place = f"{case.name}: {name}({time - begin:g} s)"
            mark = "" if abs(value - right) <= max(answer.tolerance, 1e-12) else "  DIFFERS"
            print(f"{place} is {value:.12g} by FMPy, right is {right:.12g}: {value - right:+.3g}{mark}")


if __name__ == "__main__":
    if "--fmpy" in sys.argv:
        measure()
    else:
        print(page(), end="")
