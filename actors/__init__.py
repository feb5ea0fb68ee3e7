"""A hand: ask for work, do it with functions of ``icrl_dist``, send what happened."""
