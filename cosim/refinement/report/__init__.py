"""The page about a refinement."""
