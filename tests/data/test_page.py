"""The HTML page: whole in itself, escaped, its pictures exact, written whole or not at all."""

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import LINEAR
from mi_ntf.data.page import Page, new_figure

URI = re.compile(r"data:image/([\w+]+);base64,([A-Za-z0-9+/=]+)")


def pictures(html: str) -> list[np.ndarray]:
    """Return the pictures in a page, in their order."""
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(content)))) for _, content in URI.findall(html)]


def full() -> Page:
    """Return a page with every kind of content."""
    page = Page("Skull")
    page.section("Numbers")
    page.text("All is well.")
    page.warning("Not quite.")
    page.table(["what", "value"], [["gain", 0.34]], folded="more")
    page.pictures([("one", np.zeros((4, 6, 3), np.uint8)), ("two", np.zeros((200, 300, 3), np.float32))])
    page.curves("Loss", {"red": ([0, 1], [1, 2]), "costs $2 or $3": ([0, 1, 2], [1, np.nan, 3])}, "step", "L", log=True)
    return page


def test_the_page_needs_nothing_else():
    html = full().html()
    assert [kind for kind, _ in URI.findall(html)] == ["png", "jpeg", "png"]
    rest = URI.sub("", html)
    assert "http" not in rest and "<script" not in rest and "url(" not in rest and "<link" not in rest
    assert set(re.findall(r'(?:src|href)="([^"]*)"', rest)) == {""}


def test_every_text_is_escaped():
    evil, page = '<b>&"x"', Page('<b>&"x"')
    page.section(evil)
    page.text(evil)
    page.warning(evil)
    page.table([evil], [[evil]], folded=evil)
    page.pictures([(evil, np.zeros((2, 2, 3)))])
    page.figure(new_figure(1, 1), evil)
    html = page.html()
    assert "<b>" not in html and '"x"' not in html
    assert html.count("&lt;b&gt;&amp;&quot;x&quot;") == 12  # title twice, each picture's caption twice


def test_words_between_backticks_are_code():
    page = Page("title")
    for add in (page.text, page.warning, lambda text: page.table(["`head`"], [[text]])):
        add("run `colmap a < b` and `that`, not ` this")
    assert page.html().count("run <code>colmap a &lt; b</code> and <code>that</code>, not ` this") == 3
    assert "<th><code>head</code></th>" in page.html()


def test_pictures_come_out_as_they_went_in():
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 256, (10, 12, 3), np.uint8)
    page = Page("p")
    page.pictures([("levels", levels), ("linear", LINEAR[levels]), ("nan", np.full((1, 1, 3), np.nan)),
                   ("too bright", np.full((1, 1, 3), np.inf))], width=99)
    same, linear, nan, bright = pictures(page.html())
    np.testing.assert_array_equal(same, levels)
    np.testing.assert_array_equal(linear, levels)
    assert (nan == 0).all() and (bright == 255).all() and page.html().count('width="99"') == 4
    large = np.broadcast_to(np.linspace(0, 1, 300, dtype=np.float32)[:, None, None], (300, 200, 3))
    page = Page("p")
    page.pictures([("large", LINEAR[np.round(255 * large).astype(int)])])
    assert np.abs(pictures(page.html())[0] - 255.0 * large).max() <= 4  # JPEG of quality 90


def test_a_picture_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"shape \(H, W, 3\), found \(4, 4\)"):
        Page("p").pictures([("grey", np.zeros((4, 4)))])


def test_curves_are_drawn_in_their_colours():
    (figure,) = pictures(full().html())[2:]
    assert figure.shape == (450, 1125, 4)
    opaque = figure[figure[..., 3] == 255][:, :3].astype(int)
    assert (np.abs(opaque - (0xE0, 0x43, 0x3A)).max(1) < 8).sum() > 100  # red
    assert (figure[..., 3] == 0).mean() > 0.8  # the page shows through


def test_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    full().write(path)
    before = path.read_text(encoding="utf-8")
    assert before == full().html()
    with monkeypatch.context() as patch:
        patch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        with pytest.raises(MiNtfError, match=r"page.html \(No space left"):
            Page("other").write(path)
    assert path.read_text(encoding="utf-8") == before and list(tmp_path.iterdir()) == [path]


def test_what_is_wide_scrolls_by_itself_and_by_keyboard():
    page = Page("p")
    page.table(["a"], [["b"]])
    figure = new_figure(4, 2)
    figure.add_subplot().plot([0, 1], [0, 1])
    page.drawing(figure, "a line, rising", 700)
    html = page.html()
    assert html.count('<div class="wide" tabindex="0" role="region" aria-label="') == 2
    assert '<svg' in html and 'style="min-width: 700px' in html and 'aria-label="a line, rising"' in html
    assert "http" not in html and "<script" not in html  # nothing of another place, and no script without a button


def test_texts_to_copy_have_a_button_and_one_script():
    page = Page("p")
    for text in ("<a/>\n", "mi-ntf"):
        page.markup(Page.code(text, "Paste & go:"))
    html = page.html()
    assert "<pre>&lt;a/&gt;</pre>" in html and "Paste &amp; go:" in html
    assert html.count('<button type="button" class="copy">') == 2 and html.count("<script>") == 1
