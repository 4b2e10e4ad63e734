"""Refinement of fields by photographs under any light, by Dr.Jit's derivatives."""

from .page import print_summary
from .refining import refine

__all__ = ["print_summary", "refine"]
