"""`python -m tests.known` prints docs/known.md; `--fmpy` what FMPy's `simulate_fmu` makes of the cases of one FMU."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.known.cases import CASES
from tests.known.table import Case, Run

HEAD = """# Known answers

The numbers of these systems are known without a simulator: from a formula, a sentence of a standard, or another
integrator at a tolerance of 1e-12. `tests/test_known.py` runs each of them. `tests/known/` has the equations, scenarios
and tolerances. `python -m tests.known > docs/known.md` writes this page.

FMPy is not the answer. `python -m tests.known --fmpy` runs the cases of a single FMU by its `simulate_fmu`. Where its
number differs, the last column says which one it is, and who is right. An empty cell: several FMUs, or a key of cosim.
"""
TABLE = "\n## {title}\n\n| case | system | right value and its source | FMPy 0.3.32 |\n|---|---|---|---|\n"


def written() -> str:
    """Return docs/known.md."""
    page = HEAD
    for kind, cases in CASES.items():
        page += TABLE.format(title=kind[0].upper() + kind[1:])
        for case in cases:
            cells = [text.replace("|", "\\|") for text in (case.system, case.source, case.fmpy)]
            page += f"| {' | '.join([f'`{case.name}`', *cells])} |\n"
    every = [case for cases in CASES.values() for case in cases]
    return page + f"\n{len(every)} systems, {sum(len(case.variants) for case in every)} runs.\n"


def measure(case: Case) -> None:
    """Print the right numbers beside those of FMPy, for the last run of a case."""
    import fmpy

    run = [*case.variants.values()][-1]
    assert isinstance(run, Run)
    with tempfile.TemporaryDirectory() as folder:
        content = run.written(Path(folder))
        part, *sources = content["components"].values()
        begin = content.get("start_time", 0.0)
        made = fmpy.simulate_fmu(
            part["fmu"], start_time=begin, stop_time=begin + content["duration"], output_interval=content["step"],
            relative_tolerance=content.get("tolerance"), start_values=part.get("start", {}), record_events=False,
            output=[a.signal[2:] for a in case.answers if a.signal.startswith("m.")],
            input=np.genfromtxt(sources[0]["file"], delimiter=",", names=True) if sources else None,
        )  # fmt: skip
    print(f"{case.name}: {case.fmpy}")
    for answer in case.answers:
        if (name := answer.signal[2:]) in made.dtype.names:
            time = made["time"][-1] if answer.time is None else answer.time
            value = made[name][np.argmin(np.abs(made["time"] - time))]
            print(f"    {name}({time - begin:g} s) is {value:.12g}, right is {np.ravel(answer.value)[-1]:.12g}")


if __name__ == "__main__":
    if "--fmpy" in sys.argv:
        for one in [case for cases in CASES.values() for case in cases if case.fmpy]:
            measure(one)
    else:
        print(written(), end="")
