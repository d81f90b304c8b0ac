"""Surfels of a capture: first ones, stereo, training, what views agree on."""
