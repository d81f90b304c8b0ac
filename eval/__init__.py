"""Benchmarks of TRON and their reports (`tron-eval`): what was measured, against what, and how to see it.

A benchmark is one file of :mod:`eval.benchmark`; it returns rows (:mod:`eval.results`), curves and
pictures, of which one template of :mod:`eval.report` makes a page. Nothing here trains or makes data sets:
data and weights come from disk, or from the other console commands. The tracer's own benchmark traces
(:mod:`eval.tracing`).
"""
