"""Access: connects to a run's endpoint with credentials, and explains why the endpoint refuses a connection."""

from __future__ import annotations

import argparse
import json
import socket
import stat
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh

_REFUSED_ATTEMPTS = 2
"""The endpoint has refused us after it has accepted and closed this many connections in a row."""

_RETRY_INTERVAL_S = 0.2

_OPEN_TIMEOUT_MS = 5000
"""Longest wait for an endpoint that accepts a connection and then sends nothing."""


class AccessError(RuntimeError):
    """The endpoint refuses the connection, or nothing answers; the message says which, and what to do."""


@dataclass(frozen=True)
class Credentials:
    """Our identity, and the authority that we trust. Paths name PEM files; `None` = not used."""

    user: str | None = None
    password: str | None = None
    ca: str | None = None
    """Certificate of the authority that signed the run's certificate."""
    certificate: str | None = None
    """Our own certificate, where the run asks for one."""
    key: str | None = None

    def settings(self) -> dict[str, object]:
        """The settings of zenoh that follow from these credentials."""
        settings: dict[str, object] = {}
        if self.user is not None:
            settings["transport/auth/usrpwd/user"] = self.user
            settings["transport/auth/usrpwd/password"] = self.password
        tls: dict[str, object] = {}
        if self.ca is not None:
            tls["root_ca_certificate"] = self.ca
        if self.certificate is not None:
            tls |= {"connect_certificate": self.certificate, "connect_private_key": self.key, "enable_mtls": True}
        if tls:
            settings["transport/link/tls"] = tls
        return settings


ANONYMOUS = Credentials()


def add_arguments(group: argparse._ArgumentGroup) -> None:
    """Adds the options for credentials."""
    group.add_argument("--user", metavar="NAME", help="user name, if the run requires one")
    group.add_argument(
        "--password-file", metavar="FILE", help="file with the user's password, readable by its owner only"
    )
    group.add_argument(
        "--ca", metavar="FILE", help="certificate of the authority that signed the certificate of a tls/ endpoint (PEM)"
    )
    group.add_argument("--certificate", metavar="FILE", help="your own certificate, if the run requires one (PEM)")
    group.add_argument("--key", metavar="FILE", help="private key of your certificate (PEM)")


def credentials_from(options: argparse.Namespace) -> Credentials:
    """The credentials that these options name. Raises `AccessError` if a file is missing or unsafe."""
    if (options.user is None) != (options.password_file is None):
        raise AccessError("--user and --password-file must be given together")
    if (options.certificate is None) != (options.key is None):
        raise AccessError("--certificate and --key must be given together")
    for name in ("ca", "certificate", "key"):
        path = getattr(options, name)
        if path is not None and not Path(path).is_file():
            raise AccessError(f"--{name} {path}: there is no such file")
    password = None if options.password_file is None else _read_password(Path(options.password_file))
    return Credentials(options.user, password, options.ca, options.certificate, options.key)


def _read_password(path: Path) -> str:
    try:
        mode, text = path.stat().st_mode, path.read_text(encoding="utf-8")
    except OSError as error:
        raise AccessError(f"--password-file {path}: {error.strerror}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise AccessError(f"--password-file {path} can be read by other users of this machine: chmod 600 {path}")
    password = text.rstrip("\r\n")
    if not password:
        raise AccessError(f"--password-file {path} is empty")
    return password


def config(endpoint: str, credentials: Credentials = ANONYMOUS) -> zenoh.Config:
    """Configuration of a client of `endpoint` that does not scout, cannot be scouted, and tries once to connect."""
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 0,
        "transport/unicast/open_timeout": _OPEN_TIMEOUT_MS,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    result = zenoh.Config()
    for key, value in (settings | credentials.settings()).items():
        result.insert_json5(key, json.dumps(value))
    return result


def connect(endpoint: str, timeout_s: float, credentials: Credentials = ANONYMOUS) -> zenoh.Session:
    """Opens a session to the fan-out at `endpoint`, and waits at most `timeout_s` for the fan-out to listen.

    An endpoint that accepts connections and closes them refuses us: the wait ends at once. Raises `AccessError`.
    """
    deadline, refused_attempts = time.monotonic() + timeout_s, 0
    while True:
        try:
            return zenoh.open(config(endpoint, credentials))
        except zenoh.ZError as error:
            reason = str(error)
        refused_attempts = refused_attempts + 1 if _is_listening(endpoint) else 0
        if refused_attempts == _REFUSED_ATTEMPTS:
            raise AccessError(_refusal_message(endpoint, credentials, reason))
        if time.monotonic() + _RETRY_INTERVAL_S > deadline:
            raise AccessError(_no_answer_message(endpoint, timeout_s))
        time.sleep(_RETRY_INTERVAL_S)


def _is_listening(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=1.0):
            return True
    except (OSError, OverflowError):
        return False


def _refusal_message(endpoint: str, credentials: Credentials, reason: str) -> str:
    if credentials.user is None and credentials.certificate is None:
        hint = (
            "it requires credentials: give --user and --password-file, or --certificate and --key.\n"
            "  A run without passwords admits only the user who started it"
        )
    elif credentials.user is None:
        hint = "it does not accept this certificate, or it requires --user and --password-file as well"
    else:
        hint = (
            f"it does not know the user {credentials.user!r} with this password (or it requires none: leave --user out)"
        )
    if endpoint.startswith("tls/") and credentials.ca is None:
        hint += (
            ".\n  A tls/ endpoint also needs --ca, the certificate of the authority that signed the run's certificate"
        )
    elif endpoint.startswith("tcp/"):
        hint += ".\n  If its `fanout.listen` is tls/…, write tls/HOST:PORT and give --ca"
    if "ertificate" in reason or "UnknownIssuer" in reason:
        hint += f".\n  TLS reports: {reason.split(' at ')[0][:200]}"
    return f"refused by {endpoint}: {hint}. The run's logs/fanout.log says why it refused."


def _no_answer_message(endpoint: str, timeout_s: float) -> str:
    return (
        f"nothing answers at {endpoint} within {timeout_s:g} s.\n"
        "  Is a run active, with `fanout.enabled = true`? Its endpoint is `fanout.listen` in its configuration.\n"
        "  A run on another machine listens on its own loopback: open a tunnel first, "
        "`ssh -L 7447:127.0.0.1:7447 HOST`."
    )
