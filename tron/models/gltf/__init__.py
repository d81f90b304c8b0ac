"""glTF 2.0 and GLB files, read as the specification says and refused by name where they cannot be."""
