"""Measurements of hjbjax, not part of the package: ``python -m benchmarks NAME --help``."""
