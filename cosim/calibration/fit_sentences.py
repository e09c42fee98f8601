"""Sentences about a fit, each derived from the numbers."""

from __future__ import annotations

from collections.abc import Iterator

from cosim.base.text import amount, counted, join_names, plain, size
from cosim.calibration import messages
from cosim.calibration.fit_record import Outcome
from cosim.calibration.replay_proof import Part
from cosim.residuals.replay_sentences import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN

MOST = 2  # outputs in a headline


def verdict(fitted: Outcome) -> str:
    """Return the verdict: a headline, and sentences on what was estimated."""
    part = fitted.decisive
    count = sum(entry.status != "held" for entry in fitted.parameters.values())
    estimate = fitted.estimate
    runs = counted(estimate.logs.count, "simulation")
    effort = f"{counted(count, 'parameter')} from {counted(len(fitted.logs), 'log')} by {runs}."
    if part is None:
        return f"The fit was stopped before its proof. The best values so far: {effort}"
    return f"{_headline(fitted, part)} {effort}"


def _headline(fitted: Outcome, part: Part) -> str:
    logs = counted(len(part.after), "sealed log" if part.sealed else "log")
    where = f"On {logs}" if part.sealed else f"On the {logs} of the estimate"
    error = "free-run error" if part.horizon == FREE_RUN else f"error over {horizon_name(part.horizon)}"
    words = _changes(fitted, part)
    unproven = "" if part.sealed else " No sealed log confirms it."
    if fitted.verdict == "improved":
        return f"{where} the {error} falls: {words}.{unproven}"
    if fitted.verdict == "worse":
        return f"{where} the {error} does not fall: {words}."
    return f"{where} the {error} hardly changes: {words}."


def _changes(fitted: Outcome, part: Part) -> str:
    """Return the errors before and after of the outputs that change most."""
    errors = {n: (a, b) for n, (a, b) in part.errors(part.horizon).items() if a > 0.0 and b > 0.0}
    units = {n: u for r in part.after for n, u in r.log.units.items()}
    order = sorted(errors, key=lambda n: errors[n][1] / errors[n][0], reverse=fitted.verdict == "worse")
    texts = [f"{n} from {size(errors[n][0], units[n])} to {size(errors[n][1], units[n])}" for n in order[:MOST]]
    return join_names(texts) or "there is none"


def _about_values(fitted: Outcome) -> Iterator[str]:
    """Yield warnings about bounds and wide intervals."""
    for name, entry in fitted.parameters.items():
        if entry.status == "at_bound":
            yield messages.AT_BOUND(name=name, value=amount(entry.value, entry.unit, 4))
        elif entry.ci95 is not None and entry.ci95[1] - entry.ci95[0] > abs(entry.start) > 0.0:
            yield messages.UNCERTAIN(name=name)


def warnings(fitted: Outcome) -> Iterator[str]:
    """Yield the warnings of a fit."""
    estimate = fitted.estimate
    for c in estimate.combinations:
        held = fitted.parameters[c.held]
        yield messages.HELD(sentence=c.sentence, held=c.held, value=amount(held.value, held.unit, 4))
    if estimate.idle:
        yield messages.IDLE(names=join_names(estimate.idle))
    yield from _about_values(fitted)
    if estimate.covariance is not None and not estimate.settled:
        yield messages.NOT_CONVERGED()
    if estimate.logs.first_failure is not None:
        values, error = estimate.logs.first_failure
        shown = ", ".join(f"{n} = {plain(v, 4)}" for n, v in values.items() if n in fitted.parameters)
        counts = {"count": estimate.logs.failed, "runs": estimate.logs.count}
        yield messages.FAILED_RUNS(**counts, values=shown, reason=error)
    if estimate.dropped:
        yield messages.DROPPED_STARTS(names=join_names(estimate.dropped))
    if fitted.risen:
        yield messages.RISEN(names=join_names(fitted.risen))
    if estimate.covariance is not None and (names := estimate.above_noise()):
        yield messages.ABOVE_NOISE(names=join_names(names))


def notes(fitted: Outcome) -> Iterator[str]:
    """Yield the notes of a fit."""
    estimate = fitted.estimate
    if estimate.logs.horizon is not None:
        yield messages.WINDOWS_USED(horizon=estimate.logs.horizon, reason=estimate.reason)
