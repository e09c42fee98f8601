"""Content of fit.json, the result of a fit for other programs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from cosim.core.text import join_names
from cosim.core.version import __version__
from cosim.credibility.bands import Coverage

Finite = Annotated[float, Field(allow_inf_nan=False)]
Verdict = Literal["improved", "unchanged", "worse", "stopped"]
Status = Literal["estimated", "at_bound", "held"]
Form = Literal["ratio", "product", "sum", "difference", "combination"]


class ProfileEntry(BaseModel):
    """Profile likelihood of a parameter: all other parameters are estimated again at each value."""

    values: list[Finite]
    deviance: list[Finite] = Field(
        description="2·(max ln L − ln L), scaled for residuals that are not white; 3.84 at the ends of ci95"
    )
    ci95: tuple[Finite | None, Finite | None] = Field(
        description="null: the deviance stays below 3.84 up to the bound, or the FMU fails before"
    )


class ParameterEntry(BaseModel):
    """A parameter that all logs share."""

    value: Finite
    unit: str
    start: Finite = Field(description="value before the fit")
    low: Finite | None = Field(description="bound, null without one")
    high: Finite | None
    tolerance: Finite | None = Field(
        description="half-width of the 95 % interval of a prior around start; null without prior"
    )
    ci95: tuple[Finite, Finite] | None = Field(description="95 % confidence interval; null if not identifiable alone")
    status: Status = Field(description="held: fixed at start because of a combination, or without effect")
    profile: ProfileEntry | None = None


class LogEntry(BaseModel):
    """A parameter of one log."""

    log: str
    name: str
    value: Finite
    unit: str
    ci95: tuple[Finite, Finite] | None


class StartEntry(LogEntry):
    """A start value of one log."""

    named: bool = Field(description="true: named by the user; false: equal to a measured output")


class ChoiceEntry(BaseModel):
    """A parameter that screening has selected or rejected."""

    name: str
    effect: Finite | None = Field(description="effect of a change by 10 %, in standard deviations of the noise")
    estimated: bool
    reason: str


class CombinationEntry(BaseModel):
    """Parameters that the logs determine only in combination."""

    names: list[str]
    held: str
    form: Form
    expression: str

    @property
    def sentence(self) -> str:
        """Return a sentence on the combination."""
        if self.form == "combination":
            return f"{join_names(self.names)} are not identifiable one by one from these logs"
        return f"{join_names(self.names)} are only identifiable as their {self.form} {self.expression}"


class ChannelErrors(BaseModel):
    """Root mean square errors of an output over the decisive horizon."""

    unit: str
    before: Finite | None
    after: Finite | None
    noise_floor: Finite | None = Field(
        description="error of the fitted model on data simulated with itself and the noise of the log"
    )
    excess_left: Finite | None = Field(description="remaining share of the mean square error above the noise floor")


class PartErrors(BaseModel):
    """Errors on a set of logs, measured by the same replays as in `cosim replay`."""

    horizon: Finite | None = Field(description="decisive horizon [s], null for free runs")
    channels: dict[str, ChannelErrors]
    horizons: dict[str, dict[str, tuple[Finite | None, Finite | None]]] = Field(
        description="horizon → output → errors before and after"
    )


class NoiseEntry(BaseModel):
    """Residual of an output after the fit."""

    sigma: Finite = Field(description="standard deviation")
    colour: Finite | None = Field(description="variance of its mean relative to white noise; 1 for white noise")


class Record(BaseModel):
    """Result of a fit."""

    schema_version: Literal[1] = 1
    version: str = __version__
    fmu: str
    logs: list[str]
    sealed: list[str]
    verdict: Verdict
    sentence: str
    windows: Finite | None = Field(description="length of the windows of the estimate [s]; null for free runs")
    windows_reason: str
    parameters: dict[str, ParameterEntry]
    starts: list[StartEntry]
    per_log: list[LogEntry] = []
    given: dict[str, Any] = Field(description="further values set by --start")
    correlation: list[list[Finite]] | None = Field(description="of the estimated parameters, in their order")
    singular_values: list[Finite] = Field(description="singular values of the sensitivities, in standard deviations")
    combinations: list[CombinationEntry]
    screening: list[ChoiceEntry]
    noise: dict[str, NoiseEntry]
    errors: dict[Literal["estimation", "sealed"], PartErrors]
    coverage: Coverage | None = Field(
        default=None, description="share of the errors of sealed logs in the error bands of fitted.fmu"
    )
    simulations: int = Field(description="runs over a whole log until the estimate, failed ones included")
    failed_simulations: int
    seconds: Finite
    display: dict[str, tuple[str, Finite, Finite]] = Field(
        default={}, description="unit → name of its display unit, factor and offset to its values"
    )
    warnings: list[str]
    notes: list[str]
