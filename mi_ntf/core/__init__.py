"""Formulas and the file format. NumPy only; the oracle for ``infer`` and ``train``."""
