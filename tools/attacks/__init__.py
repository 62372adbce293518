"""Attacks on the whole program, counted: see `tools.attacks.__main__`."""
