"""Loading of models: by registered name, model file or Python class, with checks of their declarations."""
