"""Command line that every command shares: recipe, checks, help, log, progress; the commands are elsewhere."""
