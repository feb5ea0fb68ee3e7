"""SAC experts of continuous problems: training, cache, and the trajectories made from them."""
