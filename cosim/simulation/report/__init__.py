"""Report of a run: a self-contained HTML page, or a folder of PNG figures."""
