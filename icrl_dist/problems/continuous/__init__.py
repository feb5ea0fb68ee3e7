"""Parts that the problems with vectors of actions share."""
