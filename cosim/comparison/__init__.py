"""Two runs held against each other: how far every signal differs, criteria side by side, the page."""
