"""Deploy a policy in a batch of environments (Algorithm 1)."""
