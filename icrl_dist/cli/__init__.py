"""The command line: what each command accepts, and what it does."""
