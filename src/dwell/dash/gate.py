"""Gate: access control of the page.

The server listens on loopback only. Other users of the computer and other sites in the same browser
can still reach it. Every request therefore needs a loopback name in `Host` (against DNS rebinding)
and, except for the paths in `OPEN`, the token: in the address, as a cookie or as a bearer token. A
request that changes something also needs this server's `Origin`, and a header that forms and images
of other sites cannot set.
"""

from __future__ import annotations

import hmac
import re
import secrets
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TYPE_CHECKING

from starlette.datastructures import MutableHeaders, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import JSONResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: Allowed `Host` names, with any port: `ssh -L` changes the port.
HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
#: Paths without a token; their answers contain no data of the cell.
OPEN = frozenset({"/healthz", "/readyz"})
#: Header required in requests that change something.
ACTS = "x-dwell-act"
TOKEN_BYTES = 32

#: Headers of every answer.
HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


def new_token() -> str:
    """Return a random token of `TOKEN_BYTES` bytes, as URL-safe text."""
    return secrets.token_urlsafe(TOKEN_BYTES)


@dataclass(frozen=True, slots=True)
class Gate:
    """ASGI wrapper that passes only allowed requests to an application.

    Parameters
    ----------
    port : int
        Port of the server; part of the cookie's name, because all ports of a host share cookies.
    """

    app: ASGIApp
    port: int
    token: str = field(default_factory=new_token, repr=False)

    @property
    def cookie(self) -> str:
        """Name of the cookie."""
        return f"dwell-{self.port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        token = QueryParams(scope["query_string"]).get("token", "")
        brings = scope["path"] == "/" and self._is(token)

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(HEADERS)
                if brings:
                    cookie = f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                    headers["set-cookie"] = cookie
            await send(message)

        refusal = self._refusal(scope, _single(scope["headers"]), brings=brings)
        if refusal is None:
            await self.app(scope, receive, sent)
        else:
            status, why = refusal
            await JSONResponse({"error": why}, status)(scope, receive, sent)

    def _refusal(
        self, scope: Scope, headers: Mapping[str, str], *, brings: bool
    ) -> tuple[HTTPStatus, str] | None:
        """Return the status and reason of a refusal; None if the request may pass."""
        host = headers.get("host", "")
        if not HOST.fullmatch(host):
            return HTTPStatus.FORBIDDEN, "open this page by the name of this computer only"
        if scope["path"] in OPEN:
            return None
        if not (brings or self._known(headers)):
            return (
                HTTPStatus.UNAUTHORIZED,
                "the token is missing or wrong; open the address that `dwell dash` has printed",
            )
        if scope["method"] in ("GET", "HEAD"):
            return None
        if headers.get("origin", "").lower() != f"http://{host.lower()}":
            return HTTPStatus.FORBIDDEN, "a command must come from this page (Origin)"
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return HTTPStatus.FORBIDDEN, "a command must come from this page (Sec-Fetch-Site)"
        if ACTS not in headers:
            return HTTPStatus.FORBIDDEN, f"a command needs the header {ACTS}"
        return None

    def _known(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the token, as a cookie or as a bearer token."""
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is(bearer.strip()):
            return True
        return self._is(cookie_parser(headers.get("cookie", "")).get(self.cookie, ""))

    def _is(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())


def _single(raw: list[tuple[bytes, bytes]]) -> dict[str, str]:
    """Return headers by name, without repeated headers."""
    pairs = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in raw]
    counts = Counter(name for name, _ in pairs)
    return {name: value for name, value in pairs if counts[name] == 1}
