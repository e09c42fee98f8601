"""What a run looked like: one self-contained HTML page, or a folder of PNG figures."""

from cosim.report.report import write_figures, write_report

__all__ = ["write_figures", "write_report"]
