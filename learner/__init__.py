"""A memory: hand out work, take in trajectories, fine-tune, broadcast."""
