"""Commands of the library: tron-relight, tron-edit and tron-reconstruct, with what belongs to one of them."""
