"""Meta-World's ML1 pick-place (appendix C.2)."""
