"""Benchmarks of seconds and bytes of hjbjax and other packages.

A file has the name of its command.
"""
