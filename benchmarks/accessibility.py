"""Run axe-core on pages in Chromium and list what hinders readers who use a keyboard or a screen reader.

axe-core is no part of neeco (MPL-2.0): `npm pack axe-core`, unpack it, and name its axe.min.js.

    python benchmarks/accessibility.py --axe package/axe.min.js runs/mine/report.html page.html http://127.0.0.1:8080/

Exit status 1 where something is serious or critical.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

CHROMIUM = "/usr/bin/chromium"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZES, SCHEMES = ((1440, 900), (390, 844)), ("light", "dark")
SERIOUS = ("serious", "critical")
SETTLE_MS = 2500  # until a page with a canvas has rendered


def violations(browser: Browser, address: str, size: tuple[int, int], scheme: str, axe: str) -> list[dict[str, Any]]:
    """Return what axe finds wrong with the page at `address`, with the pixels by which it is wider than its window."""
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]},
        color_scheme="dark" if scheme == "dark" else "light",
        bypass_csp=True,
    )
    page = context.new_page()
    page.goto(address, wait_until="load")
    page.wait_for_timeout(SETTLE_MS)
    page.add_script_tag(content=axe)
    found: list[dict[str, Any]] = page.evaluate("axe.run().then(result => result.violations)")
    wider = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    if wider > 0:
        found.append({"id": "overflow", "impact": "serious", "help": f"{wider} px wider than the window", "nodes": []})
    context.close()
    return found


def main() -> int:
    """Print one line for each finding, with the first element that has it; return 1 where one is serious."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axe", type=Path, required=True, help="axe.min.js")
    parser.add_argument("--chromium", default=CHROMIUM)
    parser.add_argument("pages", nargs="+", help="HTML files or addresses")
    args = parser.parse_args()
    serious = 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=args.chromium, args=FLAGS)
        for page in args.pages:
            address = page if "://" in page else Path(page).resolve().as_uri()
            for size in SIZES:
                for scheme in SCHEMES:
                    found = violations(browser, address, size, scheme, args.axe.read_text(encoding="utf-8"))
                    serious += sum(item["impact"] in SERIOUS for item in found)
                    print(f"{page}, {size[0]} px, {scheme}: {len(found)} findings")
                    for item in found:
                        first = item["nodes"][0]["html"][:120] if item["nodes"] else ""
                        print(f"  {item['impact']}: {item['id']}: {item['help']} ({len(item['nodes'])}x) {first}")
        browser.close()
    return 1 if serious else 0


if __name__ == "__main__":
    sys.exit(main())
