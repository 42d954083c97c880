"""rerun's web page without what calls home: no fonts from elsewhere, and a policy that binds it to this machine."""

from __future__ import annotations

import re
import threading
import urllib.error
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, urlsplit

FILES = {
    "/": "/",
    "/re_viewer.js": "/re_viewer.js",
    "/re_viewer_bg.wasm": "/re_viewer_bg.wasm",
    "/favicon.ico": "/favicon.ico",
}
"""What is handed out, and where rerun's own server has it."""

_ELSEWHERE = re.compile(rb'<link\b[^>]*"https?://[^>]*>', re.DOTALL)
_LENGTH = "rerun-final-length"
_CHUNK = 1 << 16


def without_elsewhere(page: bytes) -> bytes:
    """The page without links to other hosts."""
    return _ELSEWHERE.sub(b"", page)


def policy(grpc_port: int) -> str:
    """A content security policy: this page, and rerun's server on this machine."""
    return "; ".join(
        [
            "default-src 'none'",
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'",
            "style-src 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "font-src 'self' data:",
            "worker-src 'self' blob:",
            f"connect-src 'self' http://127.0.0.1:{grpc_port} http://localhost:{grpc_port}",
            "base-uri 'none'",
            "frame-ancestors 'self'",
        ]
    )


class Page:
    """A server of its own, in threads of this process."""

    def __init__(self, host: str, port: int, upstream_port: int, grpc_port: int) -> None:
        handler = type(
            "Handler", (_Handler,), {"upstream": f"http://{host}:{upstream_port}", "policy": policy(grpc_port)}
        )
        handler.target = "/?" + _query(host, grpc_port)
        self._server = ThreadingHTTPServer((host, port), handler)
        self._server.daemon_threads = True
        self.url = f"http://{host}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, name="page", daemon=True).start()

    def close(self) -> None:
        """Stops serving."""
        self._server.shutdown()
        self._server.server_close()


def _query(host: str, grpc_port: int) -> str:
    url = quote(f"rerun+http://{host}:{grpc_port}/proxy", safe="")
    return f"url={url}&hide_welcome_screen&persist=false&theme=dark"


class _Handler(BaseHTTPRequestHandler):
    upstream: str
    policy: str
    target: str

    def do_GET(self) -> None:
        asked = urlsplit(self.path)
        path = FILES.get(asked.path)
        if path is None:
            self.send_error(404)
        elif path == "/" and "url=" not in asked.query:
            # Whoever asks for more than the page (`?renderer=webgl`) gets both.
            self.send_response(302)
            self.send_header("Location", "&".join(filter(None, [self.target, asked.query])))
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            self._hand_out(path)

    def _hand_out(self, path: str) -> None:
        try:
            with urllib.request.urlopen(self.upstream + path, timeout=30) as answer:
                body = answer.read()
                kind, length = (
                    answer.headers.get("Content-Type", "application/octet-stream"),
                    answer.headers.get(_LENGTH),
                )
        except (urllib.error.URLError, TimeoutError):
            self.send_error(502, "rerun's server does not answer")
            return
        if path == "/":
            body, length = without_elsewhere(body), None
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", self.policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        if length is not None:
            self.send_header(_LENGTH, length)
        self.end_headers()
        for start in range(0, len(body), _CHUNK):
            self.wfile.write(body[start : start + _CHUNK])

    def handle_one_request(self) -> None:
        try:
            super().handle_one_request()
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass
