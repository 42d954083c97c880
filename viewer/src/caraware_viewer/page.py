"""Serves rerun's page without access to other hosts: no remote fonts, and a policy that allows this machine only."""

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
"""The paths that are served, and their paths on rerun's own server."""

_REMOTE_LINK = re.compile(rb'<link\b[^>]*"https?://[^>]*>', re.DOTALL)
_LENGTH = "rerun-final-length"
_CHUNK = 1 << 16


def without_remote_links(page: bytes) -> bytes:
    """The page without links to other hosts."""
    return _REMOTE_LINK.sub(b"", page)


def security_policy(grpc_port: int) -> str:
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
            # `caraware panel` embeds the page; its port is not known here.
            "frame-ancestors 'self' http://127.0.0.1:* http://localhost:*",
        ]
    )


class Page:
    """A web server in threads of this process."""

    def __init__(self, host: str, port: int, upstream_port: int, grpc_port: int) -> None:
        class Handler(_PageHandler):
            upstream = f"http://{host}:{upstream_port}"
            policy = security_policy(grpc_port)
            target = "/?" + _query(host, grpc_port)

        self._server = ThreadingHTTPServer((host, port), Handler)
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


class _PageHandler(BaseHTTPRequestHandler):
    upstream: str
    """Address of rerun's own server."""
    policy: str
    target: str
    """Path of the page with the address of the recording."""

    def do_GET(self) -> None:
        request = urlsplit(self.path)
        path = FILES.get(request.path)
        if path is None:
            self.send_error(404)
        elif path == "/" and "url=" not in request.query:
            # Options of the request, such as `?renderer=webgl`, are kept beside the address of the recording.
            self.send_response(302)
            self.send_header("Location", "&".join(filter(None, [self.target, request.query])))
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            self._serve(path)

    def _serve(self, path: str) -> None:
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
            body, length = without_remote_links(body), None
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
