"""Sentences about a fit, each derived from the numbers."""

from __future__ import annotations

from collections.abc import Iterator

from cosim.calibration.fit_record import Outcome
from cosim.core.text import amount, counted, join_names, plain, size
from cosim.residuals.replay_sentences import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN

MOST = 2  # outputs in a headline


def verdict(fitted: Outcome) -> str:
    """Return the verdict: a headline with the outputs that change most, and a sentence on what was estimated."""
    part = fitted.decisive
    count = sum(entry.status != "held" for entry in fitted.parameters.values())
    runs = counted(fitted.estimate.logs.count, "simulation")
    effort = f"{counted(count, 'parameter')} from {counted(len(fitted.logs), 'log')} by {runs}."
    if part is None:
        return f"The fit was stopped before its proof. The best values so far: {effort}"
    logs = counted(len(part.after), "sealed log" if part.sealed else "log")
    where = f"On {logs}" if part.sealed else f"On the {logs} of the estimate"
    error = "free-run error" if part.horizon == FREE_RUN else f"error over {horizon_name(part.horizon)}"
    errors = {n: (a, b) for n, (a, b) in part.errors(part.horizon).items() if a > 0.0 and b > 0.0}
    units = {n: u for r in part.after for n, u in r.log.units.items()}
    order = sorted(errors, key=lambda n: errors[n][1] / errors[n][0], reverse=fitted.verdict == "worse")
    texts = [f"{n} from {size(errors[n][0], units[n])} to {size(errors[n][1], units[n])}" for n in order[:MOST]]
    change = {"improved": "falls", "worse": "does not fall"}.get(fitted.verdict, "hardly changes")
    unproven = " No sealed log confirms it." if fitted.verdict == "improved" and not part.sealed else ""
    return f"{where} the {error} {change}: {join_names(texts) or 'there is none'}.{unproven} {effort}"


def warnings(fitted: Outcome) -> Iterator[str]:
    """Yield the warnings of a fit."""
    estimate = fitted.estimate
    for c in estimate.combinations:
        held = fitted.parameters[c.held]
        yield (
            f"{c.sentence}; {c.held} is held at {amount(held.value, held.unit, 4)}, and none of them has an interval"
        )
    if estimate.idle:
        yield f"no effect on any measured output of these logs, so the value is kept: {join_names(estimate.idle)}"
    for name, entry in fitted.parameters.items():
        if entry.status == "at_bound":
            yield (
                f"{name} ends at its bound {amount(entry.value, entry.unit, 4)}: its interval ignores the bound, "
                "and the bound may be wrong"
            )
        elif entry.ci95 is not None and entry.ci95[1] - entry.ci95[0] > abs(entry.start) > 0.0:
            yield (
                f"{name} is barely determined by these logs: its 95 % interval is wider than its value before the fit"
            )
    if estimate.covariance is not None and not estimate.settled:
        yield "the estimate did not settle: the likelihood is rough, and the intervals are unsure"
    if estimate.logs.first_failure is not None:
        values, error = estimate.logs.first_failure
        shown = ", ".join(f"{n} = {plain(v, 4)}" for n, v in values.items() if n in fitted.parameters)
        count = f"{estimate.logs.failed} of {estimate.logs.count}"
        yield f"{count} simulations failed and were rejected, first at {shown}: {error}"
    if estimate.dropped:
        yield f"windows have start values of their own, so {join_names(estimate.dropped)} is not estimated"
    if fitted.risen:
        yield (
            f"on sealed logs the error of {join_names(fitted.risen)} rises by more than its scatter from part to part"
        )
    if estimate.covariance is not None and (names := estimate.above_noise()):
        yield (
            f"the error of {join_names(names)} stays above the noise and is not white: no value of these "
            "parameters explains it. `cosim refine` looks for what the FMU lacks, with a study of the same logs"
        )
