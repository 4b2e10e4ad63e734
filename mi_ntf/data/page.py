"""HTML pages for reports. A page contains everything that it shows: it needs no network and no other file.

Every text is escaped; words between backticks are code. Arrays are (H, W, 3) RGB, linear light as floats or sRGB levels
as uint8. Pillow and matplotlib (extra `train`) are imported where they are needed.
"""

import base64
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mi_ntf.core import files
from mi_ntf.data.images import levels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GREY = "#7d7d7d"  # text and lines of figures: legible on a light page and on a dark one
COLOURS = {"red": "#e0433a", "green": "#2f9e44", "blue": "#3b82e0"}  # of curves with these names
SMALL = 128 * 128  # pictures of up to this number of pixels are PNG, exact to the level; larger ones are JPEG

_STYLE = """
:root { color-scheme: light dark; --page: #fff; --ink: #1c1c1c; --warn: #fff1d6; }
@media (prefers-color-scheme: dark) { :root { --page: #17181a; --ink: #dedede; --warn: #45330f; } }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em;
       background: var(--page); color: var(--ink); }
h1 { font-size: 1.6em; overflow-wrap: anywhere; }
h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #8886; }
p.warning { background: var(--warn); border-left: 4px solid #e39b1a; padding: .4em .8em; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { padding: .15em .8em .15em 0; text-align: left; border-bottom: 1px solid #8883; vertical-align: top;
         font-variant-numeric: tabular-nums; }
.row { display: flex; flex-wrap: wrap; gap: 10px; }
figure { margin: 0 0 .5em; } figcaption { font-size: .85em; opacity: .8; overflow-wrap: anywhere; }
img { display: block; max-width: 100%; height: auto; } img.small { image-rendering: pixelated; }
summary { cursor: pointer; } code { overflow-wrap: anywhere; } .wide { overflow-x: auto; }
pre { overflow-x: auto; background: #8882; padding: .5em; margin: .2em 0; } button { font: inherit; font-size: .85em; }
"""
_COPY = """<script>
for (const button of document.querySelectorAll("button.copy")) button.addEventListener("click", () => {
  const text = button.parentElement.nextElementSibling, all = document.createRange();
  all.selectNodeContents(text);
  getSelection().removeAllRanges(); getSelection().addRange(all);
  button.textContent = document.execCommand("copy") ? "Copied" : "Press Ctrl+C";
});
</script>"""


class Page:
    """HTML page in memory; :meth:`write` puts it on the disk."""

    def __init__(self, title: str):
        self._parts = [f"<h1>{escape(title)}</h1>"]
        self._title = title

    def section(self, title: str) -> None:
        """Add a heading."""
        self._parts.append(f"<h2>{escape(title)}</h2>")

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(f"<p>{prose(text)}</p>")

    def warning(self, text: str) -> None:
        """Add a paragraph that stands out."""
        self._parts.append(f'<p class="warning">⚠ {prose(text)}</p>')

    def table(self, header: Sequence[object], rows: Iterable[Sequence[object]], folded: str = "") -> None:
        """Add a table, one text or number a cell. The text `folded`, if any, hides it until it is clicked."""
        lines = ["".join(f"<th>{prose(str(cell))}</th>" for cell in header)]
        lines += ["".join(f"<td>{prose(str(cell))}</td>" for cell in row) for row in rows]
        table = "<table>" + "".join(f"<tr>{line}</tr>\n" for line in lines) + "</table>"
        self.scrolling(f"<details><summary>{escape(folded)}</summary>{table}</details>" if folded else table, "table")

    def pictures(self, pictures: Iterable[tuple[str, np.ndarray]], width: int = 240) -> None:
        """Add a row of pictures (caption, (H, W, 3)), each shown `width` CSS pixels wide."""
        self._parts.append('<div class="row">')
        for caption, array in pictures:
            small = ' class="small"' if array.shape[1] < width else ""
            self._image(encode(array), caption, f'{small} width="{width}"', f' style="max-width: {max(width, 150)}px"')
        self._parts.append("</div>")

    def figure(self, figure: "Figure", caption: str = "") -> None:
        """Add a figure on the page's background; its text and axes should be ``GREY``."""
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=150, transparent=True)
        self._image(_uri("png", buffer.getvalue()), caption, f' width="{int(96 * figure.get_figwidth())}"')

    def curves(self, title: str, curves: Mapping[str, tuple[Sequence[float], Sequence[float]]], xlabel: str = "",
               ylabel: str = "", log: bool = False) -> None:
        """Add a diagram of curves (xs, ys) by name, with a logarithmic y axis if `log`. NaN leaves a gap."""
        figure = new_figure(7.5, 3.0)
        axes = figure.add_subplot()
        plain(axes)
        for name, (xs, ys) in curves.items():
            axes.plot(xs, ys, label=_literal(name), color=COLOURS.get(name), linewidth=1.4,
                      marker="." if len(xs) <= 100 else None)
        axes.set(xlabel=xlabel, ylabel=ylabel)
        if log:
            from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_title(_literal(title), color=GREY, fontsize=11)
        if len(curves) > 1:
            axes.legend(frameon=False, labelcolor=GREY)
        self.figure(figure)

    def drawing(self, figure: "Figure", label: str, width: int) -> None:
        """Add a figure as inline SVG, whose text can be read aloud and copied.

        It is as wide as the page, but at least `width` CSS pixels. `label` describes it to those who hear the page.
        """
        import matplotlib

        buffer = io.StringIO()
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "mi_ntf", "font.family": "sans-serif"}):
            figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
        text = re.sub(r"<metadata>.*?</metadata>", "", buffer.getvalue(), flags=re.S)
        head, _, body = text[text.index("<svg"):].partition(">")
        head = re.sub(r'\s(xmlns(:\w+)?|width|height)="[^"]*"', "", head)
        head += f' role="img" aria-label="{escape(label)}" style="min-width: {width}px; width: 100%; height: auto"'
        self.scrolling(f"{head}>{body}".replace("xlink:href", "href"), label)

    def scrolling(self, html: str, label: str) -> None:
        """Add HTML that may be wider than a phone and scrolls by itself; `label` is for those who hear the page."""
        self._parts.append(f'<div class="wide" tabindex="0" role="region" aria-label="{escape(label)}">{html}</div>')

    @staticmethod
    def code(text: str, caption: str) -> str:
        """Return the HTML of a text to copy under a caption, with a button that copies it."""
        return (f'<p>{escape(caption)} <button type="button" class="copy">Copy</button></p>'
                f"<pre>{escape(text.strip())}</pre>")

    def markup(self, html: str) -> None:
        """Add HTML as it is, not escaped. It must load no other file."""
        self._parts.append(html)

    def html(self) -> str:
        """Return the page."""
        script = [_COPY] if any('class="copy"' in part for part in self._parts) else []
        return ('<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
                f'<meta name="viewport" content="width=device-width">\n<title>{escape(self._title)}</title>\n'
                f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join([*self._parts, *script]) + "\n</body></html>\n")

    def write(self, path: Path) -> None:
        """Write the page to `path`, whole or not at all. Raises MiNtfError."""
        files.write(path, self.html())

    def _image(self, uri: str, caption: str, attributes: str, frame: str = "") -> None:
        caption = escape(caption)
        self._parts.append(f'<figure{frame}><img src="{uri}" alt="{caption}"{attributes}>'
                           f"<figcaption>{caption}</figcaption></figure>")


def prose(text: str) -> str:
    """Return the HTML of a text, in which words between backticks are code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure of `width` x `height` inches (96 CSS pixels each) without a window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def plain(axes: "Axes") -> None:
    """Make the lines and texts of `axes` ``GREY``."""
    axes.set_facecolor("none")
    axes.tick_params(colors=GREY, which="both", labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(GREY)
    for label in (axes.xaxis.label, axes.yaxis.label, axes.title):
        label.set_color(GREY)
        label.set_fontsize(9)
    axes.grid(True, color=GREY, alpha=0.2)


def encode(array: np.ndarray) -> str:
    """Return the data URI of a picture (H, W, 3): linear light as floats, or sRGB levels."""
    from PIL import Image

    if array.ndim != 3 or array.shape[2] != 3:
        raise ValueError(f"a picture has shape (H, W, 3), found {array.shape}")
    if array.dtype != np.uint8:
        array = levels(np.nan_to_num(array, nan=0.0, posinf=1.0))
    kind, options = ("png", {}) if array.shape[0] * array.shape[1] <= SMALL else ("jpeg", {"quality": 90})
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(array)).save(buffer, kind, **options)
    return _uri(kind, buffer.getvalue())


def _literal(text: str) -> str:
    """Escape dollars, between which matplotlib expects a formula."""
    return text.replace("$", r"\$")


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
