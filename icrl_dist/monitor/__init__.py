"""The live view: terminal and browser, reading the monitor plane only."""
