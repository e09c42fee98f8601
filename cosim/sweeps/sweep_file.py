"""Sweep files: scenario, factors, and recorded signals."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from cosim.files.yaml_file import Part
from cosim.scenario.scenario import Variable, scalar

Whole = Annotated[int, Field(strict=True, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
DISTRIBUTIONS = ("uniform", "log_uniform", "normal", "triangular")
VARIATION_KEYS = ("values", "grid", *DISTRIBUTIONS, "count", "each")


def _check_listed(value: Any) -> Any:
    """Return a listed value if it is valid; a value of a path may itself be a list, e.g. poles."""
    if isinstance(value, list) and (not value or any(isinstance(v, list) for v in value)):
        raise ValueError("use numbers, true or false, or text")
    return scalar(value)


def _quantity(value: Any) -> Any:
    if isinstance(value, (bool, list)):
        raise ValueError("use a number, or text such as 12 deg")
    return scalar(value)


Listed = Annotated[Any, AfterValidator(_check_listed)]
Quantity = Annotated[Any, AfterValidator(_quantity)]


class Grid(Part):
    """Evenly spaced values.

    from:  first value
    to:    last value
    count: number of values
    """

    begin: Quantity = Field(alias="from")
    end: Quantity = Field(alias="to")
    count: Count


class Varied(Part):
    """Variation of a factor by one of these keys, with numbers in its unit or text such as `12 deg`.

    values:      a list, combined with all other listed values; a value of a path may itself be a list
    grid:        evenly spaced values, combined with all other listed values
    uniform:     [low, high]
    log_uniform: [low, high], uniform in the logarithm
    normal:      [mean, standard deviation]
    triangular:  [low, most likely, high]
    within:      [low, high], limits of a normal distribution
    count:       number of seeds, for `seed` only, from the scenario's seed on; each is combined with all other values
    each:        first seed, for `seed` only; each run gets the next seed
    """

    values: list[Listed] | None = Field(default=None, min_length=1)
    grid: Grid | None = None
    uniform: tuple[Quantity, Quantity] | None = None
    log_uniform: tuple[Quantity, Quantity] | None = None
    normal: tuple[Quantity, Quantity] | None = None
    triangular: tuple[Quantity, Quantity, Quantity] | None = None
    within: tuple[Quantity, Quantity] | None = None
    count: Count | None = None
    each: Whole | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Varied:
        ways = [way for way in VARIATION_KEYS if getattr(self, way) is not None]
        if len(ways) != 1:
            raise ValueError(f"it has {' and '.join(ways) or 'no variation'}; give one of {', '.join(VARIATION_KEYS)}")
        if self.within is not None and self.normal is None:
            raise ValueError(
                "`within` only truncates a normal distribution; add `normal: [mean, deviation]`, or remove `within`"
            )
        return self

    @property
    def way(self) -> str:
        """Return the chosen way."""
        return next(way for way in VARIATION_KEYS if getattr(self, way) is not None)


class SweepFile(Part):
    """Many runs of a scenario.

    name:        title in the report; results go to results/NAME; by default the scenario's name
    description: text in the report
    scenario:    scenario file, relative to this file
    set:         path of the scenario → value in every run
    vary:        `component.variable` (a parameter or start value), `seed`, or a path of the scenario → how it varies
    sampling:    sampling of the distributions; saltelli, for Sobol indices, draws N·(2 + number of factors)
        rows, at most `runs`
    runs:        number of joint draws of all distributions; each draw is combined with all listed values
    seed:        seed of the draws
    signals:     recorded signals; by default signals of criteria, otherwise outputs of the FMUs
    samples:     number of recorded times per signal
    dask:        address of a dask scheduler, such as tcp://host:8786
    """

    name: str | None = None
    description: str = ""
    scenario: str
    set: dict[str, Any] = Field(default_factory=dict)
    vary: dict[str, Varied] = Field(min_length=1)
    sampling: Literal["latin-hypercube", "sobol", "random", "saltelli"] = "latin-hypercube"
    runs: Count = 100
    seed: Whole = 0
    signals: list[Variable] = Field(default_factory=list)
    samples: Annotated[int, Field(strict=True, ge=2, le=2000)] = 200
    dask: str | None = None
