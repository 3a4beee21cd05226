"""Benchmarks of seconds and bytes, alone and beside other people's codes.

A file is named as its command.
"""
