"""Code shared by the benchmarks: timing, memory, tables, files and thresholds.

Nothing here imports a case or a benchmark.
"""
