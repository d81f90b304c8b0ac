"""Measuring the tracer: a scene in two forms, the peers, interleaved timing, errors and memory.

:mod:`eval.tracing.benchmark` runs it all; :mod:`eval.tracing.page` writes the page.
"""
