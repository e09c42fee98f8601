"""Work with FMUs in a process of its own, which the caller watches: what they break there does not break here."""
