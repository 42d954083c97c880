"""The panel's web server: static files for every local request, data and commands only with the key of the address."""

from __future__ import annotations

import hmac
import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path
from typing import Any

from werkzeug.exceptions import BadRequest, Forbidden, HTTPException, NotFound, Unauthorized
from werkzeug.routing import Map, Rule
from werkzeug.serving import BaseWSGIServer, WSGIRequestHandler, make_server
from werkzeug.wrappers import Request, Response

from caraware_viewer.layout import SENSORS
from caraware_viewer.link import LinkError, RunKey
from caraware_viewer.panel.commands import CommandLog, RefusedCommandError
from caraware_viewer.panel.road_users import LiveRuns
from caraware_viewer.panel.runs import RunDirectories, UnknownRunError
from caraware_viewer.wire import FrameError

HOST = "127.0.0.1"
STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/panel.js": ("panel.js", "text/javascript; charset=utf-8"),
    "/dom.js": ("dom.js", "text/javascript; charset=utf-8"),
    "/form.js": ("form.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/panel.css": ("panel.css", "text/css; charset=utf-8"),
}
"""Path, file and type of what needs no key, since it is the same for everyone."""
POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",
        "connect-src 'self'",
        "frame-src http://127.0.0.1:*",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)
"""The page loads nothing from other hosts, is shown in no other page, and embeds the viewer's page on this machine."""
LARGEST_REQUEST_BYTES = 1 << 16
PS_INTERVAL_S = 1.0
"""Shortest time between two readings of the process table."""
READ_LIMIT_S = 30.0
"""Longest wait for a command that only reads."""
MOST_WORDS = 1000
"""Most arguments of a command."""


class Panel:
    """The WSGI application. `port` is the one it is served at, `key` the secret in the fragment of its address."""

    def __init__(self, commands: CommandLog, runs: Path, port: int, key: str) -> None:
        self.commands = commands
        self.live = LiveRuns()
        self._runs = RunDirectories(runs)
        self._key = key
        self._hosts = {f"{name}:{port}" for name in (HOST, "localhost")}
        self._ps_lock = threading.Lock()
        self._ps: tuple[float, list[dict[str, Any]], str | None] = (float("-inf"), [], None)
        self._keys: bytes | None = None
        self._static = {
            path: (resources.files(__package__).joinpath("static", name).read_bytes(), kind)
            for path, (name, kind) in STATIC.items()
        }
        views: dict[str, tuple[str, Callable[..., Response]]] = {
            "/api/keys": ("GET", self._get_keys),
            "/api/state": ("GET", self._get_state),
            "/api/commands": ("POST", self._start_command),
            "/api/commands/<int:number>": ("GET", self._get_command),
            "/api/commands/<int:number>/interrupt": ("POST", self._interrupt_command),
            "/api/run": ("GET", self._get_run),
            "/api/map": ("GET", self._get_map),
            "/api/users": ("GET", self._get_users),
            "/api/log": ("GET", self._get_log),
            "/api/plot": ("GET", self._get_plot),
        }
        self._urls = Map([Rule(path, endpoint=view, methods=[method]) for path, (method, view) in views.items()])

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        request = Request(environ)
        request.max_content_length = LARGEST_REQUEST_BYTES
        try:
            response = self._answer(request)
        except HTTPException as error:
            response = _json({"error": error.description}, error.code or 500)
        except (UnknownRunError, LinkError) as error:
            response = _json({"error": str(error)}, 404)
        except (RefusedCommandError, FrameError) as error:
            response = _json({"error": str(error)}, 400)
        except (OSError, subprocess.SubprocessError) as error:
            response = _json({"error": _reason(error)}, 500)
        response.headers["Content-Security-Policy"] = POLICY
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        response.headers["Cache-Control"] = "no-store"
        return response(environ, start_response)

    def _answer(self, request: Request) -> Response:
        # A page of another site reaches this port under the name of that site (DNS rebinding), or names its origin.
        if request.headers.get("Host") not in self._hosts:
            raise Forbidden("the panel answers only at its own address")
        origin = request.headers.get("Origin")
        if origin is not None and origin.removeprefix("http://") not in self._hosts:
            raise Forbidden("another page may not use the panel")
        static = self._static.get(request.path)
        if static is not None and request.method in ("GET", "HEAD"):
            return Response(static[0], content_type=static[1])
        if request.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            raise Forbidden("another page may not use the panel")
        scheme, _, given = request.headers.get("Authorization", "").partition(" ")
        if scheme != "Bearer" or not hmac.compare_digest(given.encode(), self._key.encode()):
            raise Unauthorized("the key is missing or wrong: open the address that `caraware panel` has printed last")
        view, arguments = self._urls.bind_to_environ(request.environ).match()
        response: Response = view(request, **arguments)
        return response

    def _get_keys(self, _: Request) -> Response:
        if self._keys is None:
            self._keys = self.commands.read(["keys", "--json"], READ_LIMIT_S).encode()
        return Response(self._keys, content_type="application/json")

    def _get_state(self, _: Request) -> Response:
        live, error = self._processes()
        self.live.close_idle()
        return _json(
            {
                "runs_directory": str(self._runs.root),
                "runs": self._runs.summaries(Path(run["directory"]) for run in live),
                "live": live,
                "error": error,
                "commands": self.commands.summaries(),
                "sensors": [sensor.name for sensor in SENSORS],
            }
        )

    def _processes(self) -> tuple[list[dict[str, Any]], str | None]:
        """The rows of `caraware ps --json`, at most `PS_INTERVAL_S` old, and why there are none."""
        with self._ps_lock:
            read_at, live, error = self._ps
            if time.monotonic() - read_at < PS_INTERVAL_S:
                return live, error
            try:
                live, error = json.loads(self.commands.read(["ps", "--json"], READ_LIMIT_S)), None
            except (OSError, subprocess.SubprocessError, ValueError) as failure:
                live, error = [], f"caraware ps: {_reason(failure)}"
            self._ps = (time.monotonic(), live, error)
            return live, error

    def _start_command(self, request: Request) -> Response:
        document = request.get_json()
        arguments: object = document.get("arguments") if isinstance(document, dict) else None
        if not isinstance(arguments, list) or len(arguments) > MOST_WORDS:
            raise BadRequest("a command is an object with `arguments`, a list of texts")
        if not all(isinstance(argument, str) for argument in arguments):
            raise BadRequest("an argument of a command is a text")
        return _json(self.commands.start(arguments).summary(), 201)

    def _get_command(self, _: Request, number: int) -> Response:
        command = self.commands.find(number)
        if command is None:
            raise NotFound(f"there is no command {number}")
        return _json(command.output())

    def _interrupt_command(self, _: Request, number: int) -> Response:
        command = self.commands.find(number)
        if command is None:
            raise NotFound(f"there is no command {number}")
        command.interrupt()
        return _json(command.summary())

    def _get_run(self, request: Request) -> Response:
        run = request.args.get("run", "")
        return _json(
            {
                "directory": str(self._runs.directory(run)),
                "logs": self._runs.files(run, "logs"),
                "plots": [name for name in self._runs.files(run, "plots") if name.endswith(".png")],
                "checkpoints": self._runs.checkpoints(run),
                "curriculum": self._runs.curriculum(run),
            }
        )

    def _get_map(self, request: Request) -> Response:
        return _json(self.live.map(*self._live_run(request)))

    def _get_users(self, request: Request) -> Response:
        return _json(self.live.users(*self._live_run(request)))

    def _live_run(self, request: Request) -> tuple[str, RunKey]:
        """Endpoint and key of the run that a request names."""
        directory = self._runs.directory(request.args.get("run", "")).resolve()
        environment = request.args.get("environment", 0, type=int)
        live, _ = self._processes()
        for run in live:
            if Path(run["directory"]).resolve() != directory:
                continue
            if run["endpoint"] is None:
                raise LinkError(f"{run['run']} shows nothing: its `fanout.enabled` is false")
            if run["needs_credentials"]:
                raise LinkError(f"viewers of {run['run']} must authenticate, which the panel's map cannot")
            return run["endpoint"], RunKey(run["run"], environment)
        raise LinkError("the run is not alive")

    def _get_log(self, request: Request) -> Response:
        run, name = request.args.get("run", ""), request.args.get("name", "")
        lines = self._runs.log(run, name)
        return _json({"path": str(self._runs.file(run, "logs", name)), "lines": lines})

    def _get_plot(self, request: Request) -> Response:
        run, name = request.args.get("run", ""), request.args.get("name", "")
        return Response(self._runs.file(run, "plots", name).read_bytes(), content_type="image/png")


def serve(panel: Panel, port: int) -> BaseWSGIServer:
    """A server on loopback, a thread for each request. Raises `OSError` if the port is taken."""
    return make_server(HOST, port, panel, threaded=True, request_handler=_QuietHandler)


class _QuietHandler(WSGIRequestHandler):
    def log_request(self, *_: object) -> None:
        pass


def _json(document: object, status: int = 200) -> Response:
    return Response(json.dumps(document), status=status, content_type="application/json")


def _reason(error: Exception) -> str:
    """A failure for people; of a command its own message."""
    if isinstance(error, subprocess.CalledProcessError) and error.stderr:
        return str(error.stderr.decode(errors="replace").strip())
    return str(error)
