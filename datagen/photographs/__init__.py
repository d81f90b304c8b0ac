"""Scenes as captures: pictures by a photographer or a phone, and their truth."""
