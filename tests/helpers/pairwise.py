"""Few combinations of many options: every two values of two options meet in at least one of them."""

from itertools import combinations


def pairwise(options: dict[str, tuple]) -> list[dict]:
    """Rows name → value, the same ones every time. Each begins with the first pair that no row has yet, and takes of
    every other option the value that adds most new pairs."""
    names = list(options)
    missing = dict.fromkeys(((a, u), (b, v)) for a, b in combinations(names, 2) for u in options[a] for v in options[b])
    rows = []
    while missing:
        row = dict(next(iter(missing)))
        for name in names:
            if name not in row:
                row[name] = max(options[name], key=lambda v, n=name, r=row: len(_pairs(names, {**r, n: v}, missing, n)))
        for pair in _pairs(names, row, missing):
            del missing[pair]
        rows.append({name: row[name] for name in names})
    return rows


def _pairs(names, row, missing, only=None) -> list:
    """The missing pairs that `row` has, of the option `only` alone if given."""
    found = [((a, row[a]), (b, row[b])) for a, b in combinations(names, 2) if a in row and b in row
             and only in (None, a, b)]  # fmt: skip
    return [pair for pair in found if pair in missing]
