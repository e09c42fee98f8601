"""All that is the hovercraft's on the page about a run."""
