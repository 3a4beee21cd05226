"""Measurements, beside the package and not part of it: ``python -m benchmarks NAME --help``."""
