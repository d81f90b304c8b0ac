"""What can be done with a scene: select, insert, move, bake, look; each held against an outside witness."""
