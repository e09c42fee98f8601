"""The craft with the refined actuator, flown by the regulator of before and by one made for it: `python fly.py OUT`.

OUT is the folder of make_logs.py, with `refined` that `cosim refine` left in it. The regulator of before has the lag
of eq 4.29; the other one the mean delay of the refined actuator. Both fly scenarios/regulate.yaml.
"""

import argparse
from pathlib import Path

import numpy as np

import cosim

ROOT = Path(__file__).resolve().parents[3]
WEIGHTS = "Q: [1, 0.5, 0.1, 0.01, 0]\nR: [1, 1]\n"  # eq 6.4
SEEDS, BAND = (1, 2, 3), 0.05  # [m, rad]


def settled(time: np.ndarray, values: np.ndarray) -> float:
    """Time [s] from which on a signal stays within the band; infinite where it does not."""
    outside = np.flatnonzero(np.abs(values) > BAND)
    return float(time[outside[-1] + 1]) if outside[-1] + 1 < time.size else np.inf


def fly(folder: Path) -> list[str]:
    """Lines of a table, means over seeds."""
    craft = str(folder / "craft.yaml")
    cosim.build(folder / "after", craft)
    lines = [f"{'estimator':12}{'regulator':12}{'x settles':>11}{'overshoot':>11}{'psi settles':>13}{'overshoot':>12}"]
    for estimator in ("appendix_f", "lagged"):
        design = folder / f"{estimator}.yaml"
        design.write_text(f"{WEIGHTS}estimator: {estimator}\n")
        for label, model in (("before", "hovercraft"), ("after", craft)):
            cosim.build(folder / label, model, design=design)
            found = []
            for seed in SEEDS:
                fmus = {
                    "components.plant.fmu": str(folder / "after" / "plant.fmu"),
                    "components.controller.fmu": str(folder / label / "controller.fmu"),
                }
                run = cosim.run(ROOT / "scenarios" / "regulate.yaml", set=fmus, seed=seed)
                x, psi = run["plant.x"], run["plant.psi"]
                beyond = [max(0.0, -float(v.min())) for v in (x, psi)]
                found.append([settled(run.time, x), beyond[0], settled(run.time, psi), beyond[1]])
            a, b, c, d = np.mean(found, axis=0)
            lines.append(f"{estimator:12}{label:12}{a:>9.2f} s{b:>9.3f} m{c:>11.2f} s{d:>8.3f} rad")
    return lines


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="The regulator before and after, on the refined craft")
    arguments.add_argument("out", type=Path, help="folder of make_logs.py, refined")
    print("\n".join(fly(arguments.parse_args().out)))
