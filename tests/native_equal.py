"""`python -m tests.native_equal [SCENARIO…]`: the native plant against the FMU in Python, on a minute of each scenario.

The inputs are those that the closed loop of each scenario gave its plant; every effect is awake in turn, then all of
them, with and without ground effect in roll. Printed is difference / max(1, largest value); 1e-10 is the limit.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.test_effects import CASES, EVERYTHING, named
from tests.test_native import STEP, TIGHT, by_fmu, difference

ROOT = Path(__file__).resolve().parent.parent
INPUTS = ("duty_right", "duty_left", "tilt_right", "tilt_left")
FLAT = {"roll_ground_effect": False, "table_roll_stiffness": 0.0, "table_roll_damping": 0.0}


def recorded(scenario: Path, fmus: Path, out: Path) -> list[tuple[float, ...]]:
    """Return the commands of the controller to the plant over a minute, row by row."""
    text = scenario.read_text(encoding="utf-8").replace("../build/", f"{fmus}/")
    changed = out / scenario.name
    changed.write_text(text, encoding="utf-8")
    results = out / scenario.stem  # a folder of results is of one scenario
    cosim.run(changed, results, ["duration=60"], report=False)
    table = np.genfromtxt(results / "results.csv", delimiter=",", names=True)
    columns = [table[f"controller{name}"] for name in INPUTS]
    return [tuple(row) for row in np.column_stack(columns)[:-1].tolist()]


def main() -> int:
    cases: list[dict[str, Any]] = [{}, FLAT, *(named(effects) for effects, _ in CASES)]
    cases += [named(EVERYTHING), named(EVERYTHING) | FLAT]
    worst = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cosim.build(folder)
        (native, _) = cosim.build(folder, native=True)
        scenarios = sorted(p for p in (ROOT / "scenarios").glob("*.yaml") if "controller.tilt" in p.read_text("utf-8"))
        scenarios = [p for p in scenarios if p.stem in sys.argv[1:] or len(sys.argv) == 1]
        for scenario in scenarios:
            rows = recorded(scenario, folder, folder)
            off = [
                difference(by_fmu(folder / "plant.fmu", rows, v, STEP), by_fmu(native, rows, v, STEP)) for v in cases
            ]
            worst = max(worst, *off)
            print(f"{scenario.stem}: {len(rows)} steps, {len(cases)} cases, at most {max(off):.1e}", flush=True)
    print(f"at most {worst:.1e}; {TIGHT:.0e} allowed")
    return int(worst > TIGHT)


if __name__ == "__main__":
    sys.exit(main())
