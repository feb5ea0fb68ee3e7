"""What a worker does for each kind of job, one file per kind."""
