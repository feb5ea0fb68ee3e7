"""The run folder on disk: segments, index, dataset, checkpoints, forks, the lock."""
