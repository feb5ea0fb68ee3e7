"""The jobs that a worker can do, one file a kind."""
