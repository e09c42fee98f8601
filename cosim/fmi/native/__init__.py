"""Native code: the C that is the same for every model, the compiler, and the cache of what it made."""
