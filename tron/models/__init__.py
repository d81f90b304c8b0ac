"""Models of meshes: read from glTF and OBJ, and made surfels."""
