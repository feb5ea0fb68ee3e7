"""Central learner: leases jobs, stores trajectories, fine-tunes T_theta and broadcasts its weights."""
