"""The zoo: what is lit of every kind of material, shape and light, drawn by a seed, beside path tracing."""
