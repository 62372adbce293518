"""Pretraining of the decoders: sampled rooms, networks, the two training phases, and the comparison of decoders."""
