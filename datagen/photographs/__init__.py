"""Scenes as captures: what a photographer or a phone brings home, and the truth beside."""
