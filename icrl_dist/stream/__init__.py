"""The streams between workers and the learner: wire format, links, credits, value checks."""
