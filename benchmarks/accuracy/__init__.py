"""Benchmarks of errors: against known answers, against seconds and against a dense solver.

A file is named as its command.
"""
