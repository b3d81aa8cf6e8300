"""Gate: who may see the page, and who may act.

The page's process listens on loopback alone. Other users of the computer, and pages of other sites
in the same browser, reach it there all the same. So every request says whom it is for (`Host`: a
name that was rebound to loopback gives itself away), and has the token: in the address, as a
cookie, or as a bearer's. What acts has to come from a page of this server, by `Origin` and by a
header that no other site's form or image can set.
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

#: Names of this computer by which a browser may call it, at any port: `ssh -L` changes that.
HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
#: What anybody may ask, and what it says is nothing of the cell's.
OPEN = frozenset({"/healthz", "/readyz"})
#: Header that a request which acts has to have.
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
    """Return a token that nobody guesses."""
    return secrets.token_urlsafe(TOKEN_BYTES)


@dataclass(frozen=True, slots=True)
class Gate:
    """Lets through to an application whoever may pass; see the module.

    Parameters
    ----------
    app : ASGI application
    port : int
        Of the server: cookies of one host are shared by all its ports, so that theirs have names
        of their own.
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
        """Return why a request may not pass; None where it may."""
        host = headers.get("host", "")
        if not HOST.fullmatch(host):
            return HTTPStatus.FORBIDDEN, "this page is asked for by the name of this computer only"
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
            return HTTPStatus.FORBIDDEN, "what acts has to come from this page (Origin)"
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return HTTPStatus.FORBIDDEN, "what acts has to come from this page (Sec-Fetch-Site)"
        if ACTS not in headers:
            return HTTPStatus.FORBIDDEN, f"what acts has to say so (header {ACTS})"
        return None

    def _known(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the token, as a cookie or as a bearer's."""
        scheme, _, bearer = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is(bearer.strip()):
            return True
        return self._is(cookie_parser(headers.get("cookie", "")).get(self.cookie, ""))

    def _is(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())


def _single(raw: list[tuple[bytes, bytes]]) -> dict[str, str]:
    """Return headers by name; one that comes twice is none that counts."""
    pairs = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in raw]
    counts = Counter(name for name, _ in pairs)
    return {name: value for name, value in pairs if counts[name] == 1}
