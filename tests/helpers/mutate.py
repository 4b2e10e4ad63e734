"""Seeded damage: to bytes, to texts of words, to JSON."""

import copy

import numpy as np

VALUES = (
    None, True, False, 0, 1, -1, 2, 3, 7, 0.5, -0.0, 1e-300, 1e38, 1e300, float("nan"), float("inf"), -float("inf"),
    2**31, 2**63, 10**400, "", "x", "1", "nan", "../../etc/passwd", "é\u2028\x00", "a" * 5000, [], [[]], [1], [1, 2, 3],
    [None, None, None], {}, {"a": 1},
)  # fmt: skip
"""What nobody meant to write there."""

WORDS = ("", "0", "-1", "1", "nan", "inf", "-inf", "1e39", "1e400", "4294967296", "18446744073709551616", "x", "é", "#",
         "99999999999999999999999", "0x10", "1,5", "PINHOLE", "../../x", "\x00")


def blob(rng: np.random.Generator, data: bytes, head: int = 0) -> bytes:
    """`data` with some bytes flipped, replaced, cut off, put in or moved. `head`: bytes at the start that half of the
    damage goes to."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 5, 20])):
        end = head if head and rng.random() < 0.5 else len(data)
        i = int(rng.integers(0, max(1, min(end, len(data)))))
        n = int(rng.choice([1, 2, 4, 8, 64]))
        kind = rng.integers(0, 6)
        if kind == 0 and data:
            data[i] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            data[i : i + n] = rng.bytes(len(data[i : i + n]))
        elif kind == 2:
            data[i : i + n] = (b"\xff" if rng.random() < 0.5 else b"\x00") * len(data[i : i + n])
        elif kind == 3:
            del data[i : i + n]
        elif kind == 4:
            data[i:i] = rng.bytes(n)
        else:
            del data[i:]
    return bytes(data)


def words(rng: np.random.Generator, text: str) -> str:
    """`text` with some words or lines replaced, doubled or left out."""
    lines = [line.split(" ") for line in text.split("\n")]
    for _ in range(rng.choice([1, 1, 2, 5])):
        i = int(rng.integers(0, len(lines)))
        j = int(rng.integers(0, len(lines[i]))) if lines[i] else 0
        kind = rng.integers(0, 5)
        if kind < 2 and lines[i]:
            lines[i][j] = str(rng.choice(WORDS))
        elif kind == 2:
            del lines[i][j : j + 1]
        elif kind == 3:
            lines.insert(i, list(lines[i]))
        elif len(lines) > 1:
            del lines[i]
    return "\n".join(" ".join(line) for line in lines)


def tree(rng: np.random.Generator, data):
    """JSON `data` with one to three of its values replaced, left out, renamed, doubled or wrapped."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice([1, 1, 2, 3])):
        places = list(_places(data))
        if not places:
            return data
        parent, key = places[rng.integers(0, len(places))]
        kind = rng.integers(0, 8)
        if kind < 4:
            parent[key] = VALUES[rng.integers(0, len(VALUES))]
        elif kind == 4:
            del parent[key]
        elif kind == 5 and isinstance(parent, dict):
            parent[key + "s" if rng.random() < 0.5 else key[:-1]] = parent.pop(key)
        elif kind == 6:
            parent[key] = [parent[key]] * int(rng.choice([1, 2, 100]))
        else:
            parent[key] = {"value": parent[key]} if rng.random() < 0.5 else str(parent[key])
    return data


def _places(data):
    """Every ``(container, key)`` below `data`."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield data, key
        yield from _places(value)
