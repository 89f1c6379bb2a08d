"""Access control: whoever asks needs the token, and pages of other sites are refused."""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs

from neeco.errors import NeecoError

HOST_HEADER = re.compile(r"([\w.-]+|\[[0-9a-f:.]+\])(:\d+)?", re.ASCII | re.IGNORECASE)
HOST, PORT = "127.0.0.1", 8080
TOKEN_BYTES = 24
OWN_SITE = frozenset({"same-origin", "none"})  # Sec-Fetch-Site of our own page, and of an address that a user opens
INLINE_SCRIPT = re.compile(rb"<script[^>]*>(.*?)</script>", re.DOTALL)


@dataclass(frozen=True)
class AccessControl:
    """Decides on every HTTP request, that for the page and that which opens the web socket."""

    token: str
    cookie: str = "neeco"  # that holds it; browsers send one to all ports of a host, so it should name the port
    loopback: bool = False  # whether only this machine reaches the server; its other users do

    @classmethod
    def at(cls, host: str, port: int) -> AccessControl:
        """Return that of a server on `host` and `port`, with a new token."""
        return cls(secrets.token_urlsafe(TOKEN_BYTES), f"neeco_{port}", is_loopback(host))

    def refusal(self, path: str, headers: Mapping[str, Sequence[str]]) -> str | None:
        """Why a request for `path` is refused, or None. headers: name in small letters -> all its values."""
        hosts, origins = headers.get("host", ()), headers.get("origin", ())
        if len(hosts) != 1 or len(origins) > 1 or not HOST_HEADER.fullmatch(hosts[0]):
            return "one Host and at most one Origin are expected"
        # DNS rebinding: another site's name that resolves to this machine appears as the Host
        if self.loopback and not is_loopback(re.sub(r":\d*$", "", hosts[0])):
            return "open http://127.0.0.1, not another name of this machine"
        if origins and origins[0].partition("://")[2].lower() != hosts[0].lower():
            return "a page of another site asks"
        from_elsewhere = not OWN_SITE.issuperset(headers.get("sec-fetch-site", ()))
        opened = self.in_address(path) and tuple(headers.get("sec-fetch-mode", ())) == ("navigate",)
        if from_elsewhere and not opened:  # a link with the token may be anywhere
            return "a page of another site asks"
        if not (self.in_address(path) or self._in_cookie(headers)):
            return "the token is missing or wrong; open the whole address that neeco view printed"
        return None

    def in_address(self, path: str) -> bool:
        """Whether the address itself carries the token."""
        return any(self._is_token(value) for value in parse_qs(path.partition("?")[2]).get("token", ()))

    def _in_cookie(self, headers: Mapping[str, Sequence[str]]) -> bool:
        pairs = (pair.partition("=") for value in headers.get("cookie", ()) for pair in value.split(";"))
        return any(name.strip() == self.cookie and self._is_token(value.strip()) for name, _, value in pairs)

    def _is_token(self, value: str) -> bool:
        # headers hold any bytes, as surrogates
        return hmac.compare_digest(value.encode(errors="replace"), self.token.encode())

    def page_headers(self, path: str, page: bytes, host: str) -> dict[str, str]:
        """Headers of the page: the browser loads and connects to nothing else, and remembers the token."""
        headers = {
            "Content-Security-Policy": content_security_policy(page, host),
            "Referrer-Policy": "no-referrer",  # or the address would give the token away
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
        if self.in_address(path):
            headers["Set-Cookie"] = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return headers


def content_security_policy(page: bytes, host: str) -> str:
    """The Content-Security-Policy of a page whose own scripts may run, and nothing that is injected into it."""
    scripts = [base64.b64encode(hashlib.sha256(text).digest()).decode() for text in INLINE_SCRIPT.findall(page)]
    allowed = " ".join(f"'sha256-{digest}'" for digest in scripts)
    return "; ".join(
        [
            "default-src 'none'",
            f"script-src {allowed} 'strict-dynamic' 'wasm-unsafe-eval' blob:",
            "worker-src blob:",
            "style-src 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "font-src data:",
            # such a policy cannot name an IPv6 address; browsers that know them include web sockets in 'self'
            f"connect-src 'self'{'' if host.startswith('[') else f' ws://{host}'} data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        ]
    )


def is_loopback(host: str) -> bool:
    """Whether `--host` is reachable from this machine alone."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def resolved(host: str, port: int) -> tuple[socket.AddressFamily, tuple[Any, ...]]:
    """Family and socket address of `--host`. Raises NeecoError."""
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise NeecoError(f"--host: {host!r} is unknown ({reason}); give a name or address") from None
    return found[0][0], found[0][4]


def free_port(host: str, port: int) -> int:
    """`port`, or the next one that is free on `host`. Raises NeecoError for a host or port that cannot be."""
    if not 0 < port < 65536:
        raise NeecoError(f"--port: {port} is no port; give 1 to 65535")
    family, address = resolved(host, port)
    last = OSError()
    for candidate in range(port, min(port + 100, 65536)):
        try:
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((address[0], candidate, *address[2:]))
                return candidate
        except OSError as error:
            last = error
    raise NeecoError(f"--host: {host}: --port {port} and the next ones: {last.strerror or last}; give others")


def url_of(host: str, port: int, token: str) -> str:
    """Address to open in a browser."""
    if host in ("0.0.0.0", "::", ""):
        host = socket.gethostname()
    shown = f"[{host}]" if ":" in host and not host.startswith("[") else host
    return f"http://{shown}:{port}/?token={token}"
