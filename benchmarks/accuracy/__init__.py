"""Benchmarks of errors: against known answers, against seconds and against a dense solver.

A file has the name of its command.
"""
