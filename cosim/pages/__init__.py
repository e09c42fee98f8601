"""Pages in the user's browser: signals of finished and running runs, and the work of long commands."""
