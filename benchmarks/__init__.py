"""Benchmarks and studies of mi_ntf: scripts that run in the checkout, as ``python -m benchmarks.NAME``."""
