"""Choice of a model and its checks."""
