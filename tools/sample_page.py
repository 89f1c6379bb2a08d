"""Write docs/liver-mini.html anew by this code, of the scene that it holds (`make sample-page` trains one)."""

import base64
import html
import json
import re
import zlib
from pathlib import Path

import neeco
from neeco.viewer.export import page_of

PAGE = Path(__file__).parents[1] / "docs" / "liver-mini.html"
MADE, TRAINED = "made with", "trained with"


def main() -> None:
    """Replace the page's code; what it says of its scene stays."""
    text = PAGE.read_text(encoding="utf-8")

    def block(name: str) -> bytes:
        found = re.search(f'id="{name}">(.*?)</script>', text, re.DOTALL)
        assert found is not None, name
        return zlib.decompress(base64.b64decode(found[1]))

    facts = {key: html.unescape(value) for key, value in re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text)}
    facts = {TRAINED: facts[MADE]} | facts | {MADE: f"neeco {neeco.__version__}"}
    facts[TRAINED] = facts.pop(TRAINED)  # last but one
    facts[MADE] = facts.pop(MADE)
    PAGE.write_text(page_of(json.loads(block("head")), block("scene"), "liver-mini", list(facts.items())), "utf-8")


if __name__ == "__main__":
    main()
