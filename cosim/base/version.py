"""Version of the package."""

from fmus import __version__

__all__ = ["__version__"]
