"""What the catalogue of hard cases shares: its table, both frameworks of a formula, visibility methods on a field."""

PROPERTY = "hard case"
TITLES = ("case", "method", "value checked", "error", "allowed", "result")


def table(rows) -> str:
    """Rows (case, method, value, error, allowed, whether it holds) as text in columns."""
    lines = [TITLES] + [(*row[:-1], "ok" if row[-1] else "OPEN") for row in rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(TITLES))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([text[0], "-" * (sum(widths) + 2 * len(widths)), *text[1:]])
