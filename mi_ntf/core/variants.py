"""Mitsuba's variants that the plugins run in. Here they are names alone."""

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb")
"""Linear RGB, vectorised, with derivatives. Where none is chosen, the first of them that this machine can run, as in
the stock program."""
