"""FMUs in a separate, watched process, so that their crashes stay there."""
