"""What an FMU knows about itself: its logs, the region that they cover, error bands, and the SHA-256 of its content."""
