"""Visibility methods and their maps, in memory and on disk."""
