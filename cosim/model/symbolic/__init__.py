"""The body as symbols: linear models, dependencies, and code in several languages."""
