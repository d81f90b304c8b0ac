"""Benchmarks of TRON and their reports (`tron-eval`): each figure with its reference and its pictures.

A benchmark is a class of :mod:`eval.benchmark`; it returns rows (:mod:`eval.results`), curves and
pictures, and a template of :mod:`eval.report` makes a page from them. Nothing here trains or makes data sets:
data and weights come from disk, or from the other console commands. The tracer's own benchmark traces
(:mod:`eval.tracing`).
"""
