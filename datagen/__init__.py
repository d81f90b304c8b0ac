"""The data engine: procedural scenes, path-traced and turned into training shards (``tron-datagen``)."""
