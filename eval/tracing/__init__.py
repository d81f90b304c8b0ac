"""Measuring the tracer: a scene in two forms, the peers, interleaved timing, errors and memory.

:mod:`eval.benchmarks.tracing` runs it all; :mod:`eval.report.tracing` writes the page.
"""
