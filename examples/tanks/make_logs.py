"""Logs of a tank that leaks, which its model does not know: `python examples/tanks/make_logs.py [FOLDER]`."""

import csv
import random
import sys
from math import sqrt
from pathlib import Path

LEAK, STEP, PARTS, ROWS = 0.012, 0.5, 100, 401  # [m2/s], [s]
NAMES = ("e1.csv", "e2.csv", "v1.csv")


def log(path: Path, seed: int) -> None:
    """Write a log with a new inflow every 20 s and 1 mm of gauge noise."""
    draw, level, inflow = random.Random(seed), 1.0, 0.0
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["time", "inflow [m3/s]", "level [m]"])
        for k in range(ROWS):
            if k % 40 == 0:
                inflow = round(draw.uniform(0.01, 0.05), 4)
            rows.writerow([f"{k * STEP:g}", inflow, f"{level + draw.gauss(0.0, 1e-3):.5f}"])
            for _ in range(PARTS):
                level += STEP / PARTS * (inflow - 0.02 * sqrt(level) - LEAK * level) / 0.5


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    folder.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(NAMES):
        log(folder / name, number)
    print(f"{', '.join(NAMES)} in {folder}")
