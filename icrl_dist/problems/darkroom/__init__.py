"""Dark Room (appendix C.1): a hidden goal in a square room, with exact answers."""
