"""Take the picture of the viewer's page, view.jpg: the statue, and a light with its handles.

    python docs/view.py [--out docs/view.jpg]  # 1 min; needs chromium and the extras view and test
"""

import io
import re
import shutil
import subprocess
import sys
from pathlib import Path

import tyro
from PIL import Image
from playwright.sync_api import sync_playwright

DOCS = Path(__file__).parent
LIGHT = "0.4", "1.3", "0.9"
"""Position of the light, within the view."""
STOPS = "-3"
"""Its brightness, since it is closer to the statue than in the scene."""
SCENE = DOCS.parent / "scenes" / "statue" / "scene.xml"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def main(out: Path = DOCS / "view.jpg") -> None:
    """Open the page in a headless browser, and save what it shows once all samples are there."""
    command = [sys.executable, "-m", "mi_ntf", "view", str(SCENE), "--samples", "16"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program, sync_playwright() as p:
        try:
            address = next(re.search(r"http://\S+", line)[0] for line in program.stdout if "in a browser" in line)
            browser = p.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            page = browser.new_page(viewport={"width": 1200, "height": 760})
            page.set_default_timeout(300_000)
            page.goto(address)
            page.get_by_role("alert").get_by_role("button").click()  # a browser without a GPU says so
            page.get_by_text("sample a pixel").wait_for()
            # In front of the name of the file are the three numbers of the position, and the brightness.
            for field, text in zip(page.get_by_role("textbox").all()[-5:], (*LIGHT, STOPS), strict=False):
                field.fill(text)
                field.press("Enter")
            page.wait_for_timeout(3000)
            page.get_by_text("16 samples a pixel").wait_for()
            Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(out, quality=88, optimize=True)
            browser.close()
        finally:
            program.terminate()
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    tyro.cli(main)
