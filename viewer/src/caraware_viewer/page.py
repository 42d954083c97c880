"""Serves rerun's page without access to other hosts: no remote fonts, and a policy that allows this machine only.

The page reports how long it takes to draw a frame, so that the viewer sends no more than it can draw. rerun's page
takes in some milliseconds of data for each frame that it draws, and what is beyond that waits and gets old.
"""

from __future__ import annotations

import re
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, urlsplit

FILES = {
    "/": "/",
    "/re_viewer.js": "/re_viewer.js",
    "/re_viewer_bg.wasm": "/re_viewer_bg.wasm",
    "/favicon.ico": "/favicon.ico",
}
"""The paths that are served, and their paths on rerun's own server."""

PACE_PATH = "/pace"
"""Where the page posts the time that a frame takes it, seconds, as text."""
_PACE_SCRIPT = b"""<script>
(() => {
  const least_s = 0.03, every_s = 1;
  let last_s = 0, slow = [];
  const seen = now_ms => {
    const now_s = now_ms / 1000;
    if (last_s && now_s - last_s > least_s) slow.push(now_s - last_s);
    last_s = now_s;
    requestAnimationFrame(seen);
  };
  requestAnimationFrame(seen);
  document.addEventListener("visibilitychange", () => { last_s = 0; slow = []; });
  setInterval(() => {
    if (document.hidden) return;
    const frame_s = slow.length ? slow.reduce((a, b) => a + b) / slow.length : least_s;
    slow = [];
    fetch("/pace", { method: "POST", body: frame_s.toFixed(3) }).catch(() => {});
  }, every_s * 1000);
})();
</script>"""
JOINING_S = 1.0
"""What counts for a page that loads and has not reported yet."""
_PACE_AGE_S = 10.0
"""A page that has reported nothing for so long is closed, or shows nothing."""
_MOST_BYTES = 32

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


class Pace:
    """The time that the slowest of the open pages takes for a frame."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._reports: deque[tuple[float, float]] = deque(maxlen=256)

    def report(self, frame_s: float) -> None:
        """Notes what a page reports."""
        with self._lock:
            self._reports.append((self._clock(), frame_s))

    def frame_s(self) -> float:
        """Seconds; 0 without an open page."""
        oldest_s = self._clock() - _PACE_AGE_S
        with self._lock:
            return max((frame_s for at_s, frame_s in self._reports if at_s > oldest_s), default=0.0)


class Page:
    """A web server in threads of this process."""

    def __init__(self, host: str, port: int, upstream_port: int, grpc_port: int) -> None:
        class Handler(_PageHandler):
            upstream = f"http://{host}:{upstream_port}"
            policy = security_policy(grpc_port)
            target = "/?" + _query(host, grpc_port)
            pace = Pace()

        self.pace = Handler.pace
        """How fast the pages draw that are open."""
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
    pace: Pace

    def do_GET(self) -> None:
        request = urlsplit(self.path)
        path = FILES.get(request.path)
        if path is None:
            self.send_error(404)
        elif path == "/" and "url=" not in request.query:
            self.pace.report(JOINING_S)
            # Options of the request, such as `?renderer=webgl`, are kept beside the address of the recording.
            self.send_response(302)
            self.send_header("Location", "&".join(filter(None, [self.target, request.query])))
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            self._serve(path)

    def do_POST(self) -> None:
        text = self.rfile.read(min(int(self.headers.get("Content-Length") or 0), _MOST_BYTES))
        is_own = self.headers.get("Sec-Fetch-Site", "same-origin") == "same-origin"
        if self.path != PACE_PATH or not is_own or not re.fullmatch(rb"\d{1,4}\.\d{3}", text):
            self.send_error(404)
            return
        self.pace.report(float(text))
        self.send_response(204)
        self.end_headers()

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
            body, length = without_remote_links(body).replace(b"</head>", _PACE_SCRIPT + b"</head>", 1), None
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
