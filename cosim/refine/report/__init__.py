"""What a refine and a replay look like: one self-contained HTML page each, drawn with `cosim.report`."""
