"""Sentences about a comparison, each derived from the numbers."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.core.text import amount, join_names, plain, size
from cosim.logs.log import SENSORS
from cosim.residuals.compare import ChannelSummary, Comparison
from cosim.residuals.residual_statistics import FREE_RUN


def horizon_name(horizon: float) -> str:
    """Return the name of a horizon, such as `2 s` or `free run`."""
    return "free run" if horizon == FREE_RUN else f"{horizon:g}\u00a0s"


def verdict(comparison: Comparison) -> str:
    """Return the verdict, from the first rule that applies to the channels."""
    channels = [c for c in comparison.channels if c.scores[c.measure].rows] or comparison.channels
    measure = channels[0].measure
    seconds = float(comparison.log.time[-1] - comparison.log.time[0])
    over = f"a free run of {plain(seconds)}\u00a0s" if measure == FREE_RUN else f"{measure:g}\u00a0s"
    sizes = join_names([f"{c.name} by {size(c.scores[measure].rmse, c.unit)}" for c in channels])
    lead = f"Over {over} the model misses {sizes} (rms)."
    beyond = sorted((c for c in channels if not (c.is_matched or c.lost)), key=lambda c: -c.excess)
    hidden = ""
    if lost := [c for c in channels if c.lost]:
        own = join_names([f"{c.name} by {size(c.floor.astray, c.unit)}" for c in lost])
        free = join_names([f"{c.name} by {size(c.scores[FREE_RUN].rmse, c.unit)}" for c in lost])
        hidden = (
            f"The windows do not measure {join_names([c.name for c in lost])}: this FMU keeps a state that no output "
            f"shows. Restarted from its own outputs it misses {own}. Its free run misses {free}."
        )
    if not beyond:
        if hidden:
            return f"{lead} {hidden}"
        if following := [c for c in channels if c.is_matched and not c.is_explained]:
            return f"{lead} Noise could explain that in size, but not in kind. {_cause(comparison, following)}"
        return f"{lead} The noise of the sensors explains that: this log shows nothing that the model lacks."
    cause = _cause(comparison, beyond)
    if measure == FREE_RUN:
        worst = min(beyond, key=lambda c: c.scores[FREE_RUN].fit)
        return f"{lead} The fit of {worst.name} is {amount(worst.scores[FREE_RUN].fit, '%', 2)}. {cause}"
    times = join_names([f"{plain(c.excess, 2)} times for {c.name}" for c in beyond])
    return f"{lead} That is more than the noise of the sensors explains: {times}. {cause} {hidden}".rstrip()


def _cause(comparison: Comparison, channels: Sequence[ChannelSummary]) -> str:
    """Return the probable cause of the error: a claimed error of a sensor, a delay, or the input that it follows."""
    if claimed := next((f.whole for f in comparison.findings if f.kind == SENSORS), ""):
        return f"{claimed[:1].upper()}{claimed[1:]}."
    names = {c.name for c in channels}
    late = [f for f in comparison.findings if f.kind == "delay" and f.channel in names]
    if late := [f for f in late if abs(f.numbers["delay"]) > comparison.log.step]:
        first = max(late, key=lambda f: abs(f.numbers["delay"]) / f.numbers["error"])
        return f"{first.whole}."
    pairs = [(c, u) for c in channels for u in c.inputs[:1] if u.stands_out]
    if not pairs:
        return (
            "No command stands out in the residual: the cause may be an effect that depends on the motion, "
            "a disturbance or a sensor. `cosim refine` distinguishes them."
        )
    channel, follows = max(pairs, key=lambda pair: pair[1].strength)
    rho = plain(float(follows.rho[follows.peak]), 2)
    why = "" if follows.ahead else ", or the loop answers a disturbance"
    return (
        f"The residual of {channel.name} follows {follows.name} (correlation {rho}): "
        f"the model's answer to that command is wrong or incomplete{why}."
    )
