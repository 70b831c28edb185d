"""Fakes, generators and limits for the tests and benchmarks of this repository."""
