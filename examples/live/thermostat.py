"""A thermostat in Python that sets the heater of a running oven: python examples/live/thermostat.py."""

from collections.abc import Mapping
from pathlib import Path

import cosim
from cosim.simulation.run_signals import Run

HERE = Path(__file__).resolve().parent
GOAL, BAND, POWER = 340.0, 2.0, 1500.0  # [K], [K], [W]


class Thermostat:
    """Switch the heater off above the band and on below it."""

    def __init__(self) -> None:
        self.power = POWER

    def __call__(self, time: float, row: Mapping[str, float]) -> float:
        """Return the power [W] for the last row; a function may also ask a device or another program here."""
        board = row["oven.board"]
        self.power = 0.0 if board > GOAL + BAND else POWER if board < GOAL - BAND else self.power
        return self.power


def main(build: Path = Path("build/oven"), pace: float = 20.0) -> Run:
    """Build the oven and run it for two minutes, `pace` times as fast as the clock."""
    cosim.build(build, f"{HERE / 'oven.py'}:Oven")
    oven = {"oven": {"fmu": str(build.resolve() / "plant.fmu")}}
    scenario = {"name": "thermostat", "duration": 120.0, "step": 0.1, "components": oven}
    return cosim.run(scenario, pace=pace, inputs={"oven.power": Thermostat()})


if __name__ == "__main__":
    print(f"board at the end: {main()['oven.board'][-1]:.1f} K")
