"""Report of a run: a self-contained HTML page, or a folder of PNG figures."""

from cosim.simulation.report.figures import write_figures
from cosim.simulation.report.run_page import write_report

__all__ = ["write_figures", "write_report"]
