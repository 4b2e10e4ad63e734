"""Measuring what was rendered. Never imports PyTorch."""
