"""Benchmark of the tracer: scene, peers, speed, errors, hard cases of guidance."""
