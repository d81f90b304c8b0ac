"""What a scene is made of, and how one is drawn from its seed."""
