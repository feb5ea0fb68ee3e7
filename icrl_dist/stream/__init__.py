"""The streams between workers and learner: messages, links, credits."""
