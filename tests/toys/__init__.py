"""A problem and a method of another package, 60 lines each: all that a newcomer would write."""
