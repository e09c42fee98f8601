"""Results that are there: the newest and the earlier ones of every command, found by number, name or pattern."""
