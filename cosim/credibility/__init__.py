"""The record of credibility in an FMU: logs, the region that they cover, error bands, and the content's SHA-256."""
