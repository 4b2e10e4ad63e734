"""`mi-ntf view` in a headless browser, one program and one browser for all tests."""

import io
import re
import shutil
import subprocess
import sys
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from helpers.viewed import POINT, SCENE
from PIL import Image

from mi_ntf.view.session import Session

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync",
         "--disable-component-update", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--ignore-gpu-blocklist"]
IN_VIEW = POINT.replace('x="3.4" y="3" z="2.5"', 'x="0.9" y="0.5" z="1.8"').replace("60, 50, 40", "6, 5, 4")

WATCH = """window.shown = new Set()
new MutationObserver(() => {
    const line = document.body?.innerText.match(/(\\d+) samples? a pixel/)
    if (line) window.shown.add(line[1])
}).observe(document, {subtree: true, childList: true, characterData: true})"""
"""Script that collects the numbers of samples that a page has shown. A picture of one sample is gone in a moment."""


@pytest.fixture(scope="module")
def served(folder):
    """Address of the running program, and its scene file."""
    path = folder / "served.xml"
    path.write_text(SCENE.format(lights=IN_VIEW))
    command = [sys.executable, "-m", "mi_ntf", "view", str(path), "--size", "48", "--samples", "4", "--port", "8090"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as program:
        lines = iter(program.stdout.readline, "")
        address = next((m[0] for m in (re.search(r"http://\S+(?= in a browser)", line) for line in lines) if m), None)
        try:
            yield address, path
        finally:
            program.terminate()


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium is installed (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as p:
        try:
            browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        except playwright.Error as error:
            pytest.skip(f"chromium does not start: {str(error).splitlines()[0]}")
        yield browser
        browser.close()


@pytest.fixture
def page(browser):
    page = opened(browser, 760, 480)
    yield page
    page.close()


def opened(browser, width, height):
    """Return an empty page that collects the numbers of samples."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(60_000)
    page.add_init_script(WATCH)
    return page


def button(page, name):
    return page.get_by_role("button", name=name)


def on_screen(canvas, pose, point):
    """Return the place of a scene point on the page."""
    matrix = np.linalg.inv(pose.matrix)
    x, y, z = (matrix @ [*point, 1])[:3]
    scale = 0.5 * canvas["height"] / np.tan(np.radians(pose.fov) / 2) / z
    return canvas["x"] + canvas["width"] / 2 - scale * x, canvas["y"] + canvas["height"] / 2 - scale * y


def rested(page):
    """Return the picture on the page after all its samples."""
    page.get_by_text("4 samples a pixel").wait_for()
    time.sleep(1.5)  # until it is painted, and the window's size was asked for once more
    page.get_by_text("4 samples a pixel").wait_for()
    return np.array(Image.open(io.BytesIO(page.locator("canvas").first.screenshot())).convert("RGB"))


def begun(page):
    """Wait until the page has shown a picture of one sample."""
    page.wait_for_function("window.shown.has('1')")


def test_a_light_is_dragged(page, served, tmp_path):
    address, path = served
    hosts, faults = set(), []
    page.on("request", lambda request: hosts.add(urlsplit(request.url.removeprefix("blob:")).netloc))
    page.on("websocket", lambda socket: hosts.add(urlsplit(socket.url).netloc))
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(address)
    before = rested(page)

    pose, canvas = Session(path, {}, 32).pose, page.locator("canvas").first.bounding_box()
    light = np.array([0.9, 0.5, 1.8])
    x, y = on_screen(canvas, pose, light + np.array([0.4, 0, 0]))
    page.mouse.move(x, y)
    time.sleep(0.3)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(x - 10 * step, y)
        time.sleep(0.05)
    page.mouse.up()
    page.wait_for_timeout(1000)
    after = rested(page)
    page.screenshot(path=tmp_path / "page.png")

    assert np.abs(after.astype(float) - before).mean() > 2  # of 255
    assert hosts == {urlsplit(address).netloc}
    assert faults == []

    button(page, "Save XML").click()
    page.get_by_text(re.compile("Saved .*served_view.xml")).wait_for()
    moved = Session(path.with_name("served_view.xml"), {}, 32).lights[0].position
    assert moved[0] < 0.8 and moved[1:] == pytest.approx(light[1:], abs=1e-3)  # along the arrow that was drawn at


def test_the_scenes_camera_is_one_click_away_and_is_what_is_saved(page, served):
    address, path = served
    page.goto(address)
    begun(page)  # until then it shows the picture of the page before
    before = rested(page)
    page.evaluate("window.shown.clear()")
    button(page, "See all lights").click()
    begun(page)
    away = rested(page)

    def saved():
        out = path.with_name("served_view.xml")
        out.unlink(missing_ok=True)
        button(page, "Save XML").click()
        for _ in range(600):
            if out.is_file():
                return Session(out, {}, 32).pose
            time.sleep(0.1)
        raise TimeoutError

    own = Session(path, {}, 32).pose
    assert saved() == own
    page.get_by_role("checkbox").check()
    assert np.linalg.norm(np.subtract(saved().origin, own.origin)) > 1
    page.get_by_role("checkbox").uncheck()
    page.evaluate("window.shown.clear()")
    button(page, "Scene's camera").click()
    begun(page)
    after = rested(page)
    assert np.abs(before.astype(float) - away).mean() > 4 * np.abs(before.astype(float) - after).mean()


def test_errors_have_names_and_move_no_control(page, served):
    page.goto(served[0])
    rested(page)
    place = button(page, "Save XML").bounding_box()
    button(page, "Error against raymarch").click()
    page.get_by_text(re.compile(r"Error against raymarch: transmittance_map \d+\.\d\d %")).wait_for()
    assert button(page, "Save XML").bounding_box() == place


@pytest.mark.parametrize(("width", "height"), [(390, 800), (1400, 800)])
def test_a_page_opens_with_a_picture_of_its_windows_shape(browser, served, width, height):
    for _ in range(2):
        page = opened(browser, width, height)
        page.goto(served[0])
        begun(page)  # until then it shows the picture of the page before
        rested(page)
        text = page.get_by_text("4 samples a pixel").inner_text(timeout=60_000)
        shown, canvas = re.search(r"(\d+)×(\d+)", text), page.locator("canvas").first.bounding_box()
        panel = page.get_by_text("mi-ntf: served.xml").bounding_box()
        page.close()
        assert int(shown[1]) / int(shown[2]) == pytest.approx(canvas["width"] / canvas["height"], rel=0.06)
    # A narrow window's panel covers at most a third of it, and the picture lies behind.
    assert panel["y"] > 2 * height / 3 if width == 390 else canvas["width"] + 300 < width
