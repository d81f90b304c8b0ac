"""The zoo: random materials, shapes and lights of every kind, lit and compared with path tracing."""
