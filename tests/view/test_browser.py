"""`mi-ntf view` in a headless browser: a light is dragged, the picture changes, no other server is contacted."""

import io
import re
import shutil
import subprocess
import sys
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from helpers.viewed import POINT
from PIL import Image

from mi_ntf.view.session import Session

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync",
         "--disable-component-update", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--ignore-gpu-blocklist"]
IN_VIEW = POINT.replace('x="3.4" y="3" z="2.5"', 'x="0.9" y="0.5" z="1.8"').replace("60, 50, 40", "6, 5, 4")


@pytest.fixture
def served(scene):
    """Address of the running program, and its scene file."""
    path = scene(IN_VIEW, name="served.xml")
    command = [sys.executable, "-m", "mi_ntf", "view", str(path), "--size", "48", "--samples", "4", "--port", "8090"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as program:
        lines = iter(program.stdout.readline, "")
        address = next((m[0] for m in (re.search(r"http://\S+(?= in a browser)", line) for line in lines) if m), None)
        try:
            yield address, path
        finally:
            program.terminate()


@pytest.fixture
def page():
    if CHROMIUM is None:
        pytest.skip("no chromium is installed (Debian: apt-get install chromium)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as p:
        try:
            browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        except playwright.Error as error:
            pytest.skip(f"chromium does not start: {str(error).splitlines()[0]}")
        yield browser.new_page(viewport={"width": 760, "height": 480})
        browser.close()


def on_screen(canvas, pose, point):
    """Return the place of a scene point on the page."""
    matrix = np.linalg.inv(pose.matrix)
    x, y, z = (matrix @ [*point, 1])[:3]
    scale = 0.5 * canvas["height"] / np.tan(np.radians(pose.fov) / 2) / z
    return canvas["x"] + canvas["width"] / 2 - scale * x, canvas["y"] + canvas["height"] / 2 - scale * y


def rested(page):
    """Return the picture on the page after all its samples."""
    page.get_by_text(re.compile("4 samples a pixel")).wait_for(timeout=60_000)
    time.sleep(0.5)  # until it is painted
    return np.array(Image.open(io.BytesIO(page.locator("canvas").first.screenshot())).convert("RGB"))


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

    page.get_by_role("button", name="Save XML").click()
    page.get_by_text(re.compile("Saved .*served_view.xml")).wait_for(timeout=30_000)
    moved = Session(path.with_name("served_view.xml"), {}, 32).lights[0].position
    assert moved[0] < 0.8 and moved[1:] == pytest.approx(light[1:], abs=1e-3)  # along the arrow that was drawn at
