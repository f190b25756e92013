"""Make docs/studio.png: the two tabs of `faceanim studio`, seen in a browser without a window (needs playwright)."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from faceanim.render.sequence import write_png

ROOT = Path(__file__).resolve().parent.parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = ["--headless", "--no-sandbox", "--disable-background-networking", "--use-angle=swiftshader",
             "--enable-unsafe-swiftshader"]  # fmt: skip
WIDTH = 760
"""Of each of the two pictures [pixel]."""


def pictures(address: str, executable: str) -> list[np.ndarray]:
    """Return both tabs: a smile with its muscles, and the place where muscles are edited."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1280, "height": 860})
        page.goto(address)
        page.get_by_text("updates/s").wait_for(timeout=120_000)
        page.wait_for_timeout(2000)
        for close in page.locator("button.mantine-Notification-closeButton").all():
            close.click()
        _set(page, "Happiness", 1.0)
        page.get_by_label("Muscles", exact=True).last.click()
        page.wait_for_timeout(3000)
        live = page.screenshot()
        page.get_by_role("tab", name="Muscles").click()
        page.get_by_role("button", name="Insertion", exact=True).click()
        page.wait_for_timeout(3000)
        both = [live, page.screenshot()]
        browser.close()
    decoded = [cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_COLOR) for one in both]
    return [np.ascontiguousarray(one[:, :, ::-1]) for one in decoded if one is not None]


def _set(page: Any, row: str, value: float) -> None:
    """Drag the slider of a row to a share of its length."""
    at = page.get_by_text(row, exact=True).first.bounding_box()
    boxes = [s.bounding_box() for s in page.locator("[role=slider]:visible").all()]
    thumb = min((b for b in boxes if b), key=lambda b: abs(b["y"] - at["y"]))
    track = page.locator(".mantine-Slider-track:visible").first.bounding_box()
    y = thumb["y"] + thumb["height"] / 2
    page.mouse.move(thumb["x"] + thumb["width"] / 2, y)
    page.mouse.down()
    page.mouse.move(track["x"] + value * track["width"], y, steps=5)
    page.mouse.up()


def main() -> None:
    """Start the studio, look at it, write the picture."""
    executable = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if executable is None:
        sys.exit(f"no browser was found; install one of {', '.join(BROWSERS)}")
    with tempfile.TemporaryDirectory() as work:
        command = [sys.executable, "-m", "faceanim", "studio", "--port", "0", "--no-browser", "--work", work]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            found = re.search(r"http://\S+", server.stdout.readline())
            assert found is not None
            shown = pictures(found[0], executable)
            server.send_signal(signal.SIGINT)
    high = round(WIDTH * shown[0].shape[0] / shown[0].shape[1])
    small = [cv2.resize(one, (WIDTH, high), interpolation=cv2.INTER_AREA) for one in shown]
    write_png(
        ROOT / "docs" / "studio.png", np.concatenate([small[0], np.full((high, 8, 3), 255, np.uint8), small[1]], axis=1)
    )


if __name__ == "__main__":
    main()
