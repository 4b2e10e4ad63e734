"""The commands ``explain``, ``bake`` and ``cache``."""
