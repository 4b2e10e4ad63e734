"""The text of a budget of seconds."""

import re

from ..core.errors import MiNtfError


def seconds(text: str) -> float:
    """Return the seconds of a text such as 90s, 5m or 1h. Raises MiNtfError."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([smh])", text.strip())
    value = float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
    if value < 1:
        raise MiNtfError(f"--budget is '{text}', expected a time of a second or more such as 90s, 5m or 1h")
    return value
