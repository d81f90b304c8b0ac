"""Commands of the library, with what belongs to one: tron-relight, -edit, -bake, -view, -reconstruct."""
