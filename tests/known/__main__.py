"""`python -m tests.known` prints the tables of docs/known.md; `--fmpy` the numbers of FMPy beside the right ones."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.known.cases import CASES
from tests.known.table import Case, Run


def format_cases() -> str:
    """Return the tables of docs/known.md, which the site inserts, and the answers of FMPy."""
    parts = []
    for kind, cases in CASES.items():
        rows = [(f"`{case.name}`", case.system, case.source) for case in cases]
        lines = [("case", "system", "right value and its source"), ("---", "---", "---"), *rows]
        table = ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]
        parts += [f"## {kind[0].upper()}{kind[1:]}", "\n".join(table)]
    every = [case for cases in CASES.values() for case in cases]
    parts.append(f"{len(every)} systems, {sum(len(case.variants) for case in every)} runs.")
    equal = ", ".join(f"`{case.name}`" for case in every if case.fmpy == "same")
    others = [f"- `{case.name}`: {case.fmpy}" for case in every if case.fmpy not in ("", "same")]
    parts += ["## FMPy", f"FMPy 0.3.32 gives the right value of {equal}. It differs here:", "\n".join(others)]
    return "\n\n".join(parts)


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
        print(format_cases())
