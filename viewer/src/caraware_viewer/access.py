"""Getting in: what a run's endpoint asks of those who connect, and what went wrong if it does not let us in."""

from __future__ import annotations

import argparse
import json
import socket
import stat
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh

_REFUSALS = 2
"""Times in a row that something listens and hangs up before we take it for a refusal."""

_PAUSE_S = 0.2

_OPEN_TIMEOUT_MS = 5000
"""Longest wait for an endpoint that accepts a connection and then says nothing."""


class AccessError(RuntimeError):
    """The endpoint does not let us in, or nothing answers; the message says which, and what to do."""


@dataclass(frozen=True)
class Credentials:
    """Who we are, and whom we trust. Paths are of PEM files; `None` = not used."""

    user: str | None = None
    password: str | None = None
    ca: str | None = None
    """Certificate of the authority that signed the run's certificate."""
    certificate: str | None = None
    """Our own certificate, where the run asks for one."""
    key: str | None = None

    def settings(self) -> dict[str, object]:
        """What zenoh is to be told."""
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
    """Options that say who we are."""
    group.add_argument("--user", metavar="NAME", help="user, if the run asks for one")
    group.add_argument("--password-file", metavar="FILE", help="file with the user's password, readable by you alone")
    group.add_argument("--ca", metavar="FILE", help="certificate of the authority behind a tls/ endpoint (PEM)")
    group.add_argument("--certificate", metavar="FILE", help="your own certificate, if the run asks for one (PEM)")
    group.add_argument("--key", metavar="FILE", help="its private key (PEM)")


def of_options(options: argparse.Namespace) -> Credentials:
    """The credentials that these options name. Raises `AccessError` for what cannot be used."""
    if (options.user is None) != (options.password_file is None):
        raise AccessError("--user and --password-file go together")
    if (options.certificate is None) != (options.key is None):
        raise AccessError("--certificate and --key go together")
    for name in ("ca", "certificate", "key"):
        path = getattr(options, name)
        if path is not None and not Path(path).is_file():
            raise AccessError(f"--{name} {path}: there is no such file")
    password = None if options.password_file is None else _password(Path(options.password_file))
    return Credentials(options.user, password, options.ca, options.certificate, options.key)


def _password(path: Path) -> str:
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
    """A client of `endpoint` that neither scouts nor is found, and tries once to connect."""
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
    """Opens a session to the fan-out at `endpoint`, waiting for it at most `timeout_s`.

    What listens there and hangs up on us is a refusal, which is not waited for. Raises `AccessError`.
    """
    deadline, refusals = time.monotonic() + timeout_s, 0
    while True:
        try:
            return zenoh.open(config(endpoint, credentials))
        except zenoh.ZError as error:
            reason = str(error)
        refusals = refusals + 1 if _listens(endpoint) else 0
        if refusals == _REFUSALS:
            raise AccessError(_refusal(endpoint, credentials, reason))
        if time.monotonic() + _PAUSE_S > deadline:
            raise AccessError(_silence(endpoint, timeout_s))
        time.sleep(_PAUSE_S)


def _listens(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=1.0):
            return True
    except (OSError, OverflowError):
        return False


def _refusal(endpoint: str, credentials: Credentials, reason: str) -> str:
    if credentials.user is None and credentials.certificate is None:
        hint = "it lets in only those who say who they are: give --user and --password-file, or --certificate and --key"
    elif credentials.user is None:
        hint = "it does not take this certificate, or asks for --user and --password-file as well"
    else:
        hint = f"it does not know the user {credentials.user!r} with this password (or asks for none: leave --user out)"
    if endpoint.startswith("tls/") and credentials.ca is None:
        hint += ".\n  A tls/ endpoint also needs --ca, the certificate of the authority that signed the run's"
    elif endpoint.startswith("tcp/"):
        hint += ".\n  If its `fanout.listen` is tls/…, write tls/HOST:PORT and give --ca"
    if "ertificate" in reason or "UnknownIssuer" in reason:
        hint += f".\n  TLS says: {reason.split(' at ')[0][:200]}"
    return f"refused by {endpoint}: {hint}. The run's logs/fanout.log says why it refused."


def _silence(endpoint: str, timeout_s: float) -> str:
    return (
        f"nothing answers at {endpoint} within {timeout_s:g} s.\n"
        "  Is a run going, with `fanout.enabled = true`? Its endpoint is `fanout.listen` in its configuration.\n"
        "  A run on another machine listens on its own loopback: open a tunnel first, "
        "`ssh -L 7447:127.0.0.1:7447 HOST`."
    )
