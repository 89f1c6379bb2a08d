"""A browser's page of `neeco view`, driven as a user drives it."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

CHROMIUM = "/usr/bin/chromium"
SOFTWARE = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE_S = 90.0
QUIET_S = 1.2  # without another picture: what is shown is sharp, on a busy machine too

# pictures arrive as blobs of JPEG; what was counted and kept is asked for from outside
WATCH = """
window.pictures = 0; window.shown = [];
const make = URL.createObjectURL.bind(URL);
URL.createObjectURL = blob => {
  // depth comes as PNG, whatever its type says
  if (blob.type && blob.type.startsWith("image/jpeg")) blob.slice(0, 2).arrayBuffer().then(start => {
    if (new Uint8Array(start)[0] != 0xff) return;
    window.pictures++; window.last = blob; window.at = performance.now();
  });
  return make(blob);
};
for (const name of ["texImage2D", "texSubImage2D"]) {
  const upload = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    const image = given.some(x => x instanceof HTMLImageElement || x instanceof ImageBitmap);
    if (image) window.shown.push(performance.now());
    return upload.apply(this, given);
  };
}
"""
BYTES = "async () => Array.from(new Uint8Array(await window.last.arrayBuffer()))"


class ViewerPage:
    """Opens `address` in a new page of a browser context. `requests` are all that the page asked any server for."""

    def __init__(self, context: Any, address: str, width: int = 640, height: int = 400) -> None:
        self.address, self.server = address, None
        self.page = context.new_page()
        self.page.set_viewport_size({"width": width, "height": height})
        self.requests: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.add_init_script(WATCH)
        self.response = self.page.goto(address)

    def settled(self) -> np.ndarray:
        """The picture, uint8 [H, W, 3], when no other has come for a while."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            if self.page.evaluate(f"window.pictures > 0 && performance.now() - window.at > {QUIET_S * 1e3}"):
                return np.asarray(Image.open(io.BytesIO(bytes(self.page.evaluate(BYTES)))).convert("RGB"))
            self.page.wait_for_timeout(50)
        raise AssertionError(f"no picture stood still within {PATIENCE_S} s")

    def after(self, act: Callable[[], object]) -> np.ndarray:
        """The picture that an action leads to."""
        before = self.page.evaluate("window.pictures")
        act()
        until = time.monotonic() + PATIENCE_S
        # not wait_for_function: the page forbids what it does
        while self.page.evaluate("window.pictures") == before:
            assert time.monotonic() < until, f"no other picture within {PATIENCE_S} s"
            self.page.wait_for_timeout(20)
        return self.settled()

    def set(self, label: str, value: float) -> np.ndarray:
        """Type a number beside a slider."""
        field = self._row(label).locator("input").last
        return self.after(lambda: (field.fill(f"{value:g}"), field.press("Enter")))

    def value(self, label: str) -> float:
        """The number beside a slider."""
        return float(self._row(label).locator("input").last.input_value())

    def comes_to(self, label: str, value: float) -> bool:
        """Whether the number beside a slider becomes `value`."""
        until = time.monotonic() + PATIENCE_S
        while self.value(label) != value and time.monotonic() < until:
            self.page.wait_for_timeout(20)
        return self.value(label) == value

    def tick(self, label: str) -> None:
        """Click a checkbox."""
        self._row(label).locator("input[type=checkbox]").first.click()
        self.page.wait_for_timeout(150)  # two changes within 50 ms are sent as one

    def press(self, label: str) -> None:
        """Click a button."""
        self.page.get_by_role("button", name=label, exact=True).click()
        self.page.wait_for_timeout(150)

    def choose(self, label: str, option: str) -> None:
        """Choose from a dropdown."""
        self._row(label).locator("input").first.click()
        self.page.get_by_role("option", name=option).first.click()
        self.page.wait_for_timeout(150)

    def drag(self, x: int, y: int, to_x: int, to_y: int) -> None:
        """Turn the camera."""
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.mouse.move(to_x, to_y, steps=6)
        self.page.mouse.up()

    def zoom(self, out: float) -> None:
        """Turn the mouse's wheel over the picture."""
        self.page.mouse.move(200, 200)
        self.page.mouse.wheel(0, out)

    def screenshot(self) -> np.ndarray:
        """The whole page, uint8 [H, W, 3]."""
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))

    def pixel_like(self, red: int, green: int, blue: int, near: float = 60.0) -> tuple[int, int]:
        """(x, y) of the pixel of the picture whose colour is nearest to one."""
        seen = self.screenshot()[:, : self.page.viewport_size["width"] // 2].astype(float)
        far = np.abs(seen - (red, green, blue)).sum(-1)
        y, x = np.unravel_index(far.argmin(), far.shape)
        assert far[y, x] < near, f"nothing has that colour; the nearest is {seen[y, x]}"
        return int(x), int(y)

    def text(self) -> str:
        """All that is written on the page."""
        return str(self.page.inner_text("body"))

    def wait_for(self, text: str) -> None:
        """Until it is written on the page."""
        self.page.get_by_text(text).first.wait_for(timeout=PATIENCE_S * 1e3)

    def _row(self, label: str) -> Any:
        return self.page.locator(f'xpath=//label[normalize-space()="{label}"]/ancestor::*[.//input][1]')
