"""Durations, counts and sizes as people write them: "110 s", "2.4 million", "3.3 MB"."""


def duration(seconds: float) -> str:
    """Return seconds with two digits, minutes from two minutes on, hours from two hours on."""
    for unit, name in ((3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{_digits(seconds / unit)} {name}"
    return f"{_digits(seconds)} s"


def count(number: float) -> str:
    """Return a number with two digits after thousands, millions or billions, such as "2.4 million"."""
    for unit, name in ((1e9, "billion"), (1e6, "million"), (1e3, "thousand")):
        if number >= unit:
            return f"{_digits(number / unit)} {name}"
    return f"{number:.0f}"


def size(count_of_bytes: float) -> str:
    """Return a number of bytes in kB, MB or GB."""
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count_of_bytes >= unit:
            return f"{_digits(count_of_bytes / unit)} {name}"
    return f"{count_of_bytes:.0f} bytes"


def _digits(value: float) -> str:
    """Return two significant digits, and all digits before the point, never an exponent."""
    return f"{float(f'{value:.2g}'):.6g}" if 1e-4 <= abs(value) < 100 else f"{value:.0f}"
