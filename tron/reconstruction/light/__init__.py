"""The light of a capture: from irradiance maps, or from pairs of points and the sky that photos show."""
