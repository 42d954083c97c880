"""Access and refusal, against a real zenoh session that requires a user and a password."""

from __future__ import annotations

import argparse
import json
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from ports import free_port

from caraware_viewer import access, command
from caraware_viewer.access import AccessError, Credentials
from caraware_viewer.link import RunKey

PATIENCE_S = 60.0
"""Longest wait, for a machine whose cores are busy with other work."""


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[str]:
    port = free_port()
    users = tmp_path / "users"
    users.write_text("alice:secret\n")
    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/auth/usrpwd/dictionary_file": str(users),
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        yield f"tcp/127.0.0.1:{port}"


def refusal(endpoint: str, credentials: Credentials) -> str:
    begun = time.monotonic()
    with pytest.raises(AccessError) as error:
        access.connect(endpoint, 600.0, credentials)
    assert time.monotonic() - begun < 300, "a refusal ends the wait at once"
    return str(error.value)


def test_known_users_may_connect_and_refusals_give_the_reason(guarded: str) -> None:
    access.connect(guarded, PATIENCE_S, Credentials("alice", "secret")).close()
    assert "give --user and --password-file" in refusal(guarded, Credentials())
    assert "'alice' with this password" in refusal(guarded, Credentials("alice", "wrong"))
    assert "'bob' with this password" in refusal(guarded, Credentials("bob", "secret"))


def test_a_viewer_waits_for_a_run_that_starts_to_listen() -> None:
    port = free_port()
    opened: list[zenoh.Session] = []

    def listen() -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")
        opened.append(zenoh.open(config))

    late = threading.Timer(0.7, listen)
    late.start()
    access.connect(f"tcp/127.0.0.1:{port}", PATIENCE_S).close()
    late.join()
    opened[0].close()


def test_a_closed_port_is_not_a_refusal() -> None:
    with pytest.raises(AccessError, match="nothing answers at"):
        access.connect(f"tcp/127.0.0.1:{free_port()}", 0.5)


def test_a_server_that_closes_connections_refuses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up() -> None:
            while True:
                try:
                    server.accept()[0].close()
                except OSError:
                    return

        threading.Thread(target=hang_up, daemon=True).start()
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        assert "refused by" in refusal(endpoint, Credentials())
        server.shutdown(socket.SHUT_RDWR)


def options(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    access.add_arguments(parser.add_argument_group("credentials"))
    return parser.parse_args(arguments)


def test_passwords_are_read_from_files_that_others_cannot_read(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("pass word\n")
    file.chmod(0o644)
    with pytest.raises(AccessError, match="chmod 600"):
        access.credentials_from(options("--user", "alice", "--password-file", str(file)))
    file.chmod(0o600)
    credentials = access.credentials_from(options("--user", "alice", "--password-file", str(file)))
    assert (credentials.user, credentials.password) == ("alice", "pass word")
    file.write_text("\n")
    with pytest.raises(AccessError, match="is empty"):
        access.credentials_from(options("--user", "alice", "--password-file", str(file)))
    with pytest.raises(AccessError, match="must be given together"):
        access.credentials_from(options("--user", "alice"))
    with pytest.raises(AccessError, match="no such file"):
        access.credentials_from(options("--ca", str(tmp_path / "nowhere.pem")))


def test_commands_have_a_prefix_of_their_own() -> None:
    assert command.control_key(RunKey("a/b", 2)) == "caraware-control/a%2Fb/2"
