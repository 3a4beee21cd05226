"""What the benchmarks share: turns and seconds, bytes, tables and files, and what figures are held to.

Nothing here imports a case or a benchmark.
"""
