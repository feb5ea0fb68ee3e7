"""The 11 problems of the DeepMind Control Suite (appendix C.3)."""
