"""Light from every direction: maps, cubemaps, files, prefiltering."""
