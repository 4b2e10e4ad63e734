"""The plugins and their registration."""
