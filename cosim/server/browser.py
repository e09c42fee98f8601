"""The user's browser: whether there is one, and opening a page without showing its token to other users."""

from __future__ import annotations

import html
import os
import sys
import webbrowser

from cosim.base.scratch import process_folder

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
PAGE = '<!DOCTYPE html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={url}"><title>{title}</title>'


def has_display() -> bool:
    """Return whether a browser can be opened."""
    return os.name == "nt" or sys.platform == "darwin" or any(os.environ.get(name) for name in DISPLAYS)


def open_page(url: str, title: str) -> bool:
    """Open an address in the browser; return whether a browser was started.

    The browser gets a file of this user that leads to the address: the command line of a browser, which all users of
    the machine can read, then has no token.
    """
    if not has_display():
        return False
    page = process_folder() / "open.html"
    page.touch(0o600)
    page.write_text(PAGE.format(url=html.escape(url), title=html.escape(title)), encoding="utf-8")
    return webbrowser.open(page.resolve().as_uri())
