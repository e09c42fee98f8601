"""Rows of the report on communication steps and algebraic loops."""

from __future__ import annotations

from collections.abc import Iterator

from cosim.report.html_tables import Row
from cosim.simulation.report.recorded import Run, mapping, mappings, number, texts


def loop_rows(run: Run) -> Iterator[Row]:
    """Yield a row for each algebraic loop: method, tolerance and iterations."""
    for loop in mappings(run.manifest.get("loops")):
        counts, names = mapping(loop.get("iterations")), texts(loop.get("components"))
        repeated = ", ".join(texts(loop.get("repeated")))
        lines = [
            f"{str(loop.get('method', '')).title()}, relative tolerance {number(loop.get('tolerance')):g}, "
            f"unknowns {', '.join(texts(loop.get('unknowns')))}",
            f"iterations: {counts.get('start')} at the start, at most {counts.get('most')} at a communication point, "
            f"{counts.get('total')} at {loop.get('points')} points",
            *([f"repeated steps: {repeated}"] if repeated else []),
        ]
        yield Row(f"Algebraic loop {' → '.join((*names, *names[:1]))}", "\n".join(lines))
