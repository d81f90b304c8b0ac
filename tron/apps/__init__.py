"""Commands of the library: tron-relight and tron-reconstruct, with what belongs to one of them."""
