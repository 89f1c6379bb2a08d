"""How long `neeco view` takes from a key on a slider to the picture on the screen.

    python benchmarks/view.py RUN [--times 30]

Serves RUN, opens it in Chromium (Playwright; `chromium` must be on the PATH; WebGL in software), presses an arrow key
on the first joint's slider (or the frame's) again and again, and prints the median and the 90th percentile of the time
until the new picture is handed to WebGL, for a page of 640x400 and for one whose picture alone has that size.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
from pathlib import Path
from typing import Any

from neeco.viewer.server import ViewerServer

PAGES = ((640, 400), (964, 400))
SETTLED_MS, BETWEEN_MS = 4000, 900
FIRST = 3  # not counted: things are still being loaded
WATCH = """
window.shown = [];
for (const name of ["texImage2D", "texSubImage2D"]) {
  const upload = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    const image = given.some((item) => item instanceof HTMLImageElement || item instanceof ImageBitmap);
    if (image) window.shown.push(performance.now());
    return upload.apply(this, given);
  };
}
"""
PRESS = """() => {
  window.shown.length = 0;
  window.pressed = performance.now();
  for (const type of ["keydown", "keyup"]) {
    const event = new KeyboardEvent(type, { key: "ArrowRight", code: "ArrowRight", bubbles: true });
    document.activeElement.dispatchEvent(event);
  }
}"""
TOOK = "window.shown.length ? window.shown[0] - window.pressed : null"


def delays(browser: Any, address: str, width: int, height: int, times: int) -> list[float]:
    """ms from a key to the next picture."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.add_init_script(WATCH)
    page.goto(address)
    page.wait_for_timeout(SETTLED_MS)
    sliders = page.locator('[role="slider"]')
    sliders.nth(min(1, sliders.count() - 1)).focus()  # after the frame's comes the first joint's
    found = []
    for number in range(FIRST + times):
        page.evaluate(PRESS)
        page.wait_for_timeout(BETWEEN_MS)
        took = page.evaluate(TOOK)
        if number >= FIRST and took is not None:
            found.append(float(took))
    page.close()
    return found


def main() -> None:
    """Print a line for every size of page."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--times", type=int, default=30)
    arguments = parser.parse_args()
    options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with ViewerServer(arguments.run) as viewer, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=options)
        for width, height in PAGES:
            found = delays(browser, viewer.address, width, height, arguments.times)
            low, high = statistics.median(found), statistics.quantiles(found, n=10)[-1]
            print(f"page {width}x{height}: median {low:.0f} ms, 90th percentile {high:.0f} ms, of {len(found)}")
        browser.close()


if __name__ == "__main__":
    main()
