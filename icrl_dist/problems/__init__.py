"""The problems: environments, adversaries, splits, labels and references of each."""
