"""Logs of a bench whose servo overshoots: `python examples/bench/overshoot/make_logs.py OUT [--seed N]`.

The bench of truth.yaml is built and played by the public verbs (`cosim.build`, `cosim.simulate`). Loads hung on its
cells give points that carry 0.25 % of full scale (App. B.1), a cubic through them reads the voltages, the tare is read
at rest: what is logged are forces as one has them on a bench. Beside the logs go bench.yaml, study.yaml and craft.yaml.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np

import cosim

HERE = Path(__file__).resolve().parent
STEP, GRAM = 0.02, 9.81e-3  # [s], Fig 4.8; [N] of a gf
DEGREE = np.pi / 180.0
CELLS = {"z": (-0.5, 285.0), "x": (-150.0, 150.0)}  # [gf] hung on each
POINTS, ERROR = 8, 0.0025 * 816 * GRAM  # loads a cell, their standard deviation [N]
NOISE = {"z": 0.015, "x": 0.012}  # [V] of each reading
BATTERY = 0.015  # standard deviation of the thrust from run to run, as a share
ANGLES = {"e1": (25, 0, -25, 0), "e2": (15, 25, 5, 0), "e3": (-25, -10, 20, 0), "e4": (10, -20, 25, 0),
          "v1": (25, 0, 25, 0), "v2": (-15, 20, -25, 0)}  # fmt: skip
TIMES, END, DUTY = (4.0, 6.0, 8.0, 10.0), 12.0, 6.3  # [s, s, %]


def commands(angles: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Rest, the motor run up to 3 s, then steps of the tilt [deg]."""
    time = STEP * np.arange(round(END / STEP) + 1)
    tilt = sum(
        (b - a) * (time > t - 1e-9) for t, a, b in zip(TIMES, (0, *angles[:-1]), angles, strict=True)
    )  # fmt: skip
    duty = np.interp(time, [1.0, 3.0], [5.0, DUTY])
    return {"time": time, "duty": duty, "servo_duty": 7.5 + tilt * DEGREE / 0.3927, "height": np.full(time.size, 0.095)}


def played(fmu: Path, columns: dict[str, np.ndarray], **set_values: float) -> dict[str, np.ndarray]:
    """Voltages of a run."""
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder) / "input.csv", columns)
        run = cosim.simulate(fmu, input=path, set=set_values, step=STEP, stop=float(columns["time"][-1]))
    name = run.names[0].partition(".")[0]
    return {n: run[f"{name}.{n}"] for n in ("volts_z", "volts_x")}


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """One CSV."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(f"{v:.9g}" for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def calibrated(fmu: Path, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Cell → cubic from voltage to force [N], through points whose loads are off."""
    cubics = {}
    for cell, (low, high) in CELLS.items():
        loads = GRAM * np.linspace(low, high, POINTS)
        time = STEP * np.arange(25 * POINTS)
        hung = np.repeat(loads, 25)
        noise = NOISE[cell] * rng.standard_normal(time.size)
        volts = played(fmu, {"time": time, f"load_{cell}": hung, f"noise_{cell}": noise})[f"volts_{cell}"]
        read = np.array([part[2:].mean() for part in np.split(volts[: time.size], POINTS)])
        cubics[cell] = np.polyfit(read, loads + ERROR * rng.standard_normal(POINTS), 3)
    return cubics


def make_logs(out: Path, seed: int = 1) -> Path:
    """Write logs, study.yaml and model files to `out`; return the study. Equal seeds give equal bytes."""
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        fmu = cosim.build(folder, str(HERE / "truth.yaml"))[0]
        cubics = calibrated(fmu, rng)
        for name, angles in ANGLES.items():
            told = commands(angles)
            noise = {f"noise_{c}": NOISE[c] * rng.standard_normal(told["time"].size) for c in CELLS}
            thrust = 1.0 + BATTERY * rng.standard_normal()
            volts = played(fmu, {**told, **noise}, thrust_factor=float(thrust))
            force = {f"force_{c}": np.polyval(cubics[c], volts[f"volts_{c}"][: told["time"].size]) for c in CELLS}
            rest = told["time"] < 0.9
            nothing = dict.fromkeys((f"{w}_{c}" for w in ("load", "noise") for c in "zxm"), np.zeros(rest.size))
            write(out / f"{name}.csv", {**told, **nothing, **{n: f - f[rest].mean() for n, f in force.items()}})
    for name in ("bench.yaml", "study.yaml", "craft.yaml"):
        if out.resolve() != HERE:
            shutil.copy(HERE / name, out / name)
    return out / "study.yaml"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="Logs and a study of a bench whose servo overshoots")
    arguments.add_argument("out", type=Path, help="folder for the logs and study.yaml")
    arguments.add_argument("--seed", type=int, default=1, help="of noise, calibration and the battery's state")
    given = arguments.parse_args()
    print(make_logs(given.out, given.seed))
