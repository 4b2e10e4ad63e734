"""The one exception type for faults that a user can mend."""


class MiNtfError(ValueError):
    """A fault of the input. The text names the thing, the value that was seen and the remedy."""
