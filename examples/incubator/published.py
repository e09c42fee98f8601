"""Errors of the published models on the logs of `make_logs.py`: `python examples/incubator/published.py FOLDER`.

Free runs of the two- and four-parameter models of the Incubator project with the values that it publishes, and of the
four-parameter model fitted to the estimation logs by least squares. Nothing here is of cosim.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

TWO = {
    "2020": (498.71218224, 0.62551039, 10.917042 * 9.12718588),
    "2023": (642.17187, 0.49605615, 11.416531 * 1.42706637),
}
FOUR = {
    "2020": (177.62927865, 0.77307655, 239.61236331, 2.31872819, 12.16 * 10.45),
    "2023": (267.55929458, 0.5763498, 329.25376821, 1.67053237, 12.15579391 * 1.53551347),
}
Log = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def read(path: Path) -> Log:
    """Return time, heater (0 or 1), room and box temperature."""
    with path.open(encoding="utf-8") as stream:
        columns = np.array([[float(cell) for cell in row] for row in list(csv.reader(stream))[1:]]).T
    return columns[0], (columns[1] > 0.0).astype(float), columns[2], columns[3]


def free_run(log: Log, A: np.ndarray, b: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Return the first state of ẋ = A·x + b(row), exact for inputs that hold from row to row."""
    time = log[0]
    values, vectors = np.linalg.eig(A)
    powers = np.exp(np.outer(np.diff(time), values))
    steps = np.einsum("ij,kj,jl->kil", vectors, powers, np.linalg.inv(vectors))
    rest = -np.linalg.solve(A, b)  # equilibrium of each row
    x, found = begin, [begin[0]]
    for k, step in enumerate(steps):
        x = rest[:, k] + step @ (x - rest[:, k])
        found.append(x[0])
    return np.array(found)


def two(log: Log, C: float, G: float, power: float) -> np.ndarray:
    """Return the temperature of the box: C·Ṫ = P·heater − G·(T − T_room)."""
    _, heater, room, box = log
    return free_run(log, np.array([[-G / C]]), ((power * heater + G * room) / C)[None], box[:1])


def four(log: Log, C: float, G: float, C_heater: float, G_heater: float, power: float) -> np.ndarray:
    """Return the temperature of the box, beside a heater with a capacity: C_h·Ṫ_h = P·heater − G_h·(T_h − T)."""
    _, heater, room, box = log
    A = np.array([[-(G + G_heater) / C, G_heater / C], [G_heater / C_heater, -G_heater / C_heater]])
    return free_run(log, A, np.vstack([G / C * room, power * heater / C_heater]), box[[0, 0]])


def fitted(logs: list[Log], start: tuple[float, ...]) -> tuple[float, ...]:
    """Return the values of least squares; the power keeps its value, as only ratios to it matter."""

    def residuals(logarithms: np.ndarray) -> np.ndarray:
        return np.concatenate([four(log, *np.exp(logarithms), start[4]) - log[3] for log in logs])

    return (*np.exp(least_squares(residuals, np.log(start[:4]), x_scale=0.3).x).tolist(), start[4])


def whole_of_2023(folder: Path) -> Log:
    """Return the log of 2023 in one piece."""
    first, last = (read(folder / "2023" / name) for name in ("e1.csv", "v1.csv"))
    later = last[0] + first[0][-1] + 3.0
    return np.concatenate([first[0], later]), *(np.concatenate(pair) for pair in zip(first[1:], last[1:], strict=True))


def main(folder: Path) -> None:
    """Print the table."""
    for build in ("2020", "2023"):
        logs = {path.name: read(path) for path in sorted((folder / build).glob("[ev]*.csv"))}
        own = fitted([log for name, log in logs.items() if name.startswith("e")], FOUR[build])
        for title, model, values in (
            ("two parameters, published", two, TWO[build]),
            ("four parameters, published", four, FOUR[build]),
            ("four parameters, fitted to the estimation logs", four, own),
        ):
            errors = {n: float(np.sqrt(np.mean((model(log, *values) - log[3]) ** 2))) for n, log in logs.items()}
            print(build, f"{title:48}", *(f"{name} {error:.3f} K" for name, error in errors.items()))
    for title, model, values in (("two", two, TWO["2023"]), ("four", four, FOUR["2023"])):
        whole = whole_of_2023(folder)
        error = np.sqrt(np.mean((model(whole, *values) - whole[3]) ** 2))
        print(f"2023 {title} parameters, published, whole log: {error:.3f} K")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
