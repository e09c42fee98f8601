"""YAML with line numbers, tables, results, folders, archives and the cache."""
