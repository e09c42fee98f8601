"""YAML with places, tables, results, folders, archives and the cache."""
