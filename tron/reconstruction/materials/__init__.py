"""Base color, roughness and metallic of surfels, together with the light."""
