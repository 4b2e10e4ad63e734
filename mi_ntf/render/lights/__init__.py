"""Emitters of a scene as lights of its fields."""
