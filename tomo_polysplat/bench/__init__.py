"""Benchmarks of kernels and whole reconstructions."""
