"""Rows of the report on communication steps, algebraic loops and the pace."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from cosim.base.text import amount
from cosim.report.html_tables import Row
from cosim.simulation.report.recorded import Run, mapping, mappings, number, texts

STEP = "time between two exchanges of values among the components"


def step_rows(run: Run) -> Iterator[Row]:
    """Yield the row of the communication step."""
    step, rows = run.scenario.get("step"), mapping(run.scenario.get("step"))
    if not rows:
        if step is not None:
            yield Row("Communication step", f"{number(step):g} s", STEP)
        return
    steps = mapping(run.manifest.get("steps"))
    row = number(rows.get("rows"), number(rows.get("max")))
    limits = f"{amount(number(rows.get('min')), 's')} to {amount(number(rows.get('max')), 's')}"
    lines = [f"controlled, {limits}; a row every {amount(row, 's')}"]
    if steps:
        sizes = ", ".join(f"{share} {amount(number(size), 's')}" for share, size in mapping(steps.get("sizes")).items())
        lines += [
            *_excess(steps),
            f"estimator {steps.get('estimator')}, tolerance {number(steps.get('tolerance')):g}, largest error "
            f"{number(steps.get('largest_error')):.2g}",
            f"{steps.get('accepted')} steps accepted, {steps.get('rejected')} taken back, "
            f"{steps.get('communication_points')} exchanges of values in all",
            f"sizes by share of steps that are shorter: {sizes}",
        ]
    yield Row("Communication step", "\n".join(lines), STEP)


def _excess(steps: Mapping[str, object]) -> Iterator[str]:
    """Yield a line if the error of a step is larger than the tolerance."""
    error, tolerance = number(steps.get("largest_error")), number(steps.get("tolerance"))
    if error > tolerance > 0.0:
        count = f"{steps.get('above_tolerance')} of {steps.get('accepted')} steps"
        yield f"TOLERANCE NOT MET in {count}: the largest error is {error / tolerance:.3g} times the tolerance"


def loop_rows(run: Run) -> Iterator[Row]:
    """Yield a row for each algebraic loop."""
    for loop in mappings(run.manifest.get("loops")):
        counts, names = mapping(loop.get("iterations")), texts(loop.get("components"))
        repeated = ", ".join(texts(loop.get("repeated")))
        delayed = mapping(loop.get("not_solved"))
        lines = [
            f"{str(loop.get('method', '')).title()}, relative tolerance {number(loop.get('tolerance')):g}, "
            f"unknowns {', '.join(texts(loop.get('unknowns')))}",
            f"iterations: {counts.get('start')} at the start, at most {counts.get('most')} at a communication point, "
            f"{counts.get('total')} at {loop.get('points')} points",
            *([f"repeated steps: {repeated}"] if repeated else []),
        ]
        if delayed:
            lines = [*_not_solved(delayed), *(lines if number(counts.get("most")) > 1 else [])]
        yield Row(f"Algebraic loop {' → '.join((*names, *names[:1]))}", "\n".join(lines))


def _not_solved(record: Mapping[str, object]) -> Iterator[str]:
    """Yield lines on the residual of an unsolved loop."""
    yield f"NOT SOLVED: {record.get('reason')}"
    if worst := mapping(record.get("largest")):
        shares, last = mapping(record.get("relative")), mapping(record.get("last"))
        yield (
            f"residual at the end of a step: at most {number(worst.get('residual')):+.3g} of {worst.get('signal')} at "
            f"t = {number(worst.get('time')):g} s, at last {number(last.get('residual')):+.3g}"
        )
        median, at_last = number(shares.get("median")), number(shares.get("last"))
        yield f"relative to the signal: {median:.2g} at half of the points, {at_last:.2g} at the last"


def pace_rows(run: Run) -> Iterator[Row]:
    """Yield a row on the pace of a run."""
    if not (pacing := mapping(run.manifest.get("pacing"))):
        return
    overruns, jitter, points = mapping(pacing.get("overruns")), mapping(pacing.get("jitter")), pacing.get("points")
    lines = [f"{overruns.get('count')} of {points} communication points missed, as the steps took too long"]
    if "worst" in overruns:
        lines[0] += f", at worst {_ms(overruns['worst'])} at t = {number(overruns.get('at')):g} s"
    if jitter:
        names = {"p50": "median", "p99": "99 % of the points", "p999": "99.9 %", "max": "largest"}
        delays = ", ".join(f"{name} {_ms(jitter.get(k))}" for k, name in names.items())
        lines.append(f"delay of a point: {delays}")
    yield Row("Pace", "\n".join((f"{number(pacing.get('pace')):g} × real time", *lines)))


def _ms(seconds: object) -> str:
    milliseconds = 1e3 * number(seconds)
    return "below 0.001 ms" if 0.0 < milliseconds < 1e-3 else f"{milliseconds:.3g} ms"
