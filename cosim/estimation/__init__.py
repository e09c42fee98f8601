"""Maximum likelihood on measured logs: the filter and its noise, what a fit may move, what more would promise."""
