"""Measuring the tracer: scene, peers, timing in turns, errors, hard cases of guidance."""
