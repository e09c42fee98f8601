"""Sphinx: the site of `make docs`. Nothing is loaded from elsewhere; furo brings no web font."""

project = "cosim"
author = "The cosim authors"
copyright = author
extensions = ["myst_parser"]
exclude_patterns = ["_made", "_site", "schemas"]
html_theme = "furo"
html_title = "cosim"
html_extra_path = ["_made"]
html_copy_source = False
html_show_sphinx = False
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings = [
    "myst.xref_missing",  # files of the project that are no page of the site; tests/test_docs.py tries all links
    "misc.highlighting_failure",  # CSV has no colours
]
linkcheck_timeout = 10
