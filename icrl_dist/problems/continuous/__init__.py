"""Common parts of the problems with vector actions."""
