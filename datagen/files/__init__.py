"""The user's models, textures and maps, where they come from and what they may be used for."""
