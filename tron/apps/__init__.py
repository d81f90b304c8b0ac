"""Commands of the library, with what belongs to one: tron-relight, tron-edit, tron-bake, tron-reconstruct."""
