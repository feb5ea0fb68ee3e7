"""The trained model as a user deploys it: load, act, observe, out-of-distribution score."""
