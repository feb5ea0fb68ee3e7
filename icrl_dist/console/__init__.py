"""What a command shows in the terminal: progress and tables."""
