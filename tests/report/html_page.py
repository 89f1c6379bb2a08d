"""What tests look for in a page."""

from __future__ import annotations

from collections.abc import Callable
from html import unescape
from html.parser import HTMLParser

HOSTILE = """'"><script>alert(1)<b onload=x>$x${{ 7 * 7 }}"""  # has no slash: a folder may be called so


class Page(HTMLParser):
    """Collects references and checks that elements close in order."""

    def __init__(self, void):
        super().__init__()
        self.void = void  # names of elements that have no end tag
        self.open, self.references, self.tags, self.attributes = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [name for name, _ in attrs]
        self.references += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.void:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [name for name, _ in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def check_hostile_names(write: Callable[[], str], void) -> None:
    """Pages that `write` makes of data with HOSTILE in it show it as text, and are equal to the last byte."""
    text = write()
    page = Page(void)
    page.feed(text)
    assert page.open == []
    assert "script" not in page.tags
    assert "onload" not in page.attributes
    assert HOSTILE not in text
    assert HOSTILE in unescape(text)
    assert write() == text
