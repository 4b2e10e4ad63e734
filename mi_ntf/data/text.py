"""Text of unknown encoding: UTF-8, UTF-16 or UTF-32, with or without a byte-order mark, else Latin-1."""

import json
from pathlib import Path


def read(path: Path) -> tuple[str, str | None]:
    """``(text, what was assumed)`` of a file. Raises OSError, UnicodeDecodeError."""
    text, assumed = decode(path.read_bytes())
    return text, assumed and f"{path}: {assumed}"


def decode(raw: bytes) -> tuple[str, str | None]:
    """``(text, what was assumed)``. Raises UnicodeDecodeError."""
    encoding = json.detect_encoding(raw)  # by byte-order mark and zero bytes
    try:
        return raw.decode(encoding), None
    except UnicodeDecodeError:
        if not encoding.startswith("utf-8"):
            raise
        return raw.decode("latin-1"), "is no UTF-8 and is read as Latin-1"
