"""SAC experts of continuous problems: training, cache, and trajectories from their histories."""
