"""Applications of a scene (select, insert, move, bake, view), each compared with an independent reference."""
