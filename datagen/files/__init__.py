"""The user's models, textures and maps, with sources and licences."""
