"""A sweep file: which scenario, what varies in it and how, what is kept of each run."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from cosim.scenario.scenario import Variable
from cosim.storage.yaml_file import Part

Whole = Annotated[int, Field(strict=True, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
MOST_TEXT = 1e308
WAYS = ("values", "grid", "uniform", "log_uniform", "normal", "triangular", "count", "each")


def _scalar(value: Any) -> Any:
    """A value: a finite number, true or false, or text, such as a number with a unit."""
    if isinstance(value, (bool, str)) or (isinstance(value, (int, float)) and abs(value) < MOST_TEXT):
        return value
    raise ValueError("a value is a finite number, true or false, or text such as 12 deg")


def _listed(value: Any) -> Any:
    """A value that is listed: of a path also a list, such as poles."""
    if not isinstance(value, list):
        return _scalar(value)
    if not value or any(isinstance(v, list) for v in value):
        raise ValueError("a value that is a list holds numbers, true or false, or text")
    return [_scalar(v) for v in value]


def _quantity(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("it is a number, or text such as 12 deg")
    return _scalar(value)


Listed = Annotated[Any, AfterValidator(_listed)]
Quantity = Annotated[Any, AfterValidator(_quantity)]


class Grid(Part):
    """Evenly spaced values.

    from:  the first
    to:    the last
    count: how many
    """

    begin: Quantity = Field(alias="from")
    end: Quantity = Field(alias="to")
    count: Count


class Varied(Part):
    """How one thing varies, by one of these; numbers in its unit, or text such as `12 deg`.

    values:      a list; every value goes with every other; of a path a value may be a list itself
    grid:        evenly spaced values; likewise
    uniform:     [low, high]
    log_uniform: [low, high], evenly over the logarithm
    normal:      [mean, standard deviation]
    triangular:  [low, most likely, high]
    within:      [low, high] to which a normal distribution is cut
    count:       of `seed`: so many seeds, counted from that of the scenario, each with every other value
    each:        of `seed`: another seed for each run, counted from this number
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
        given = [way for way in WAYS if getattr(self, way) is not None]
        if len(given) != 1:
            said = " and ".join(given) if given else "nothing"
            raise ValueError(f"it says {said}; give one of {', '.join(WAYS)}")
        if self.within is not None and self.normal is None:
            raise ValueError("within cuts a normal distribution; give normal, or leave it out")
        return self

    @property
    def way(self) -> str:
        """Which of the ways is given."""
        return next(way for way in WAYS if getattr(self, way) is not None)


class SweepFile(Part):
    """Many runs of one scenario.

    name:        shown in the report; results go to results/NAME; that of the scenario without
    description: shown in the report
    scenario:    the file, relative to this one
    set:         path → value, over the scenario's own, of every run
    vary:        `component.variable` (a parameter or start value), `seed`, or a path of the scenario → how it varies
    sampling:    how distributions are drawn; saltelli is for Sobol indices and makes `runs` up to N·(2 + what varies)
    runs:        how many are drawn of the distributions together; each goes with every listed value
    seed:        of what is drawn
    signals:     kept of each run; without, those of its criteria, else outputs of its FMUs
    samples:     how many times of each signal are kept
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
