"""Logs, FMU and studies of a heated box: `python examples/incubator/make_logs.py DATA_FOLDER OUT_FOLDER`.

The power is that of the published models of two parameters, by voltage and current, while the heater is on.

Two builds of the box, each with a study: `2020` (logs of December 2020, sealed: January and March 2021 until the lid
is opened) and `2023` (one log, its last part sealed). Rows are as recorded, some 3 s apart.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from compiled_fmu import compiled_fmu
from fetch import Recording, recorded, run_make_logs, write_rows, write_study

HOME = (
    "https://raw.githubusercontent.com/INTO-CPS-Association/example_digital-twin_incubator"
    "/2f08c4f6916258582715e6fc705b4c315d55baaa/software/incubator/datasets/"
)
TUNING_1 = Recording(
    "exp1_ht3_hg2.csv",
    HOME + "20201221_controller_tunning/exp1_ht3_hg2.csv",
    "2c629c44b3bf3b454a4a3ca7b9a92a310e5f2ff7777db3810228a8d8fddb42bf",
)
TUNING_2 = Recording(
    "exp2_ht20_hg30.csv",
    HOME + "20201221_controller_tunning/exp2_ht20_hg30.csv",
    "42e96a99f6ee4b3fdd56d34faf14c0256fb2ad16afe341641f48d78ed0237bb4",
)
JANUARY = Recording(
    "lid_opening_experiment_jan_2021.csv",
    HOME + "20210122_lid_opening_kalman/lid_opening_experiment_jan_2021.csv",
    "b8cc1857a3830ba882175081bb6cc1c3f4f7fce6bc52680e7011ee5a277759e8",
)
MARCH = Recording(
    "lid_opening_experiment_mar_2021.csv",
    HOME + "20210321_lid_opening_7pmodel/lid_opening_experiment_mar_2021.csv",
    "d77e0dd13660c93b00ff0597962007f9e29263980bc6c8479058ffd73a9281d5",
)
EMPTY = Recording(
    "20230501_calibration_empty_system.csv",
    HOME + "20230501_calibration_empty_system/20230501_calibration_empty_system.csv",
    "f9a0a4dcc71ba2b5636ab827f43ae6d94cd3d8b64bfb52c363ae48a81dbb14dc",
)


@dataclass(frozen=True)
class Part:
    """A log: rows of a recording between two times since its start [s], and the sensors of box and room."""

    recording: Recording
    begin: float = 0.0
    end: float = float("inf")
    inside: tuple[str, str] = ("t2", "t3")
    room: str = "t1"


POWER = {"2020": 10.917042 * 9.12718588, "2023": 11.416531 * 1.42706637}  # [W] of the heater while it is on
NEW = ("t1", "t2")  # sensors in the box since 2023; t3 is in the room
STUDIES = {
    "2020": {
        "e1.csv": Part(TUNING_1),
        "e2.csv": Part(TUNING_2),
        "v1.csv": Part(JANUARY, end=655.0),
        "v2.csv": Part(MARCH, end=2040.0),
    },
    "2023": {"e1.csv": Part(EMPTY, 0.0, 4046.0, NEW, "t3"), "v1.csv": Part(EMPTY, 4046.0, inside=NEW, room="t3")},
}


def rows(part: Part, data: Path) -> list[tuple[float, int, float, float]]:
    """Return time [s], heater, temperature of the room and of the box [°C] of each row, the time from 0."""
    with recorded(part.recording, data).open(encoding="utf-8", newline="") as stream:
        table = list(csv.DictReader(stream))
    unit = 1e-9 if len(table[0]["time"].partition(".")[0]) > 10 else 1.0  # ns since 2021
    begin = float(table[0]["time"])
    found = []
    for row in table:
        time = (float(row["time"]) - begin) * unit
        if part.begin <= time <= part.end:
            inside = 0.5 * sum(float(row[name]) for name in part.inside)
            found.append((time, int(row["heater_on"] == "True"), float(row[part.room]), inside))
    return [(time - found[0][0], *rest) for time, *rest in found]


def make_logs(data: Path, folder: Path) -> list[Path]:
    """Write a folder for each build, with logs, FMU and study; return the studies."""
    studies = []
    for build, parts in STUDIES.items():
        out = folder / build
        compiled_fmu(Path(__file__).with_name("fmu"), out / "incubator.fmu")
        for name, part in parts.items():
            power = POWER[build]
            lines = (f"{t:.3f},{power * on:.6g},{room:.3f},{inside:.4f}" for t, on, room, inside in rows(part, data))
            write_rows(out / name, "time,power [W],T_room [degC],T [degC]", lines)
        learnt, sealed = ([name for name in parts if name.startswith(kind)] for kind in "ev")
        keys, fmu = "tolerance: {C_air: 50%, G_box: 50%}\nhorizon: free run\n", out.resolve() / "incubator.fmu"
        studies.append(write_study(out, fmu, keys=keys, estimation=learnt, validation=sealed))
    return studies


if __name__ == "__main__":
    sys.exit(run_make_logs(make_logs, __doc__))
