"""Getting in and being refused, against a real zenoh session that asks for a user and a password."""

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

from caraware_viewer import access, command
from caraware_viewer.access import AccessError, Credentials
from caraware_viewer.link import RunKey


@pytest.fixture
def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def guarded(free_port: int, tmp_path: Path) -> Iterator[str]:
    users = tmp_path / "users"
    users.write_text("alice:secret\n")
    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{free_port}"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/auth/usrpwd/dictionary_file": str(users),
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        yield f"tcp/127.0.0.1:{free_port}"


def refusal(endpoint: str, credentials: Credentials) -> str:
    begun = time.monotonic()
    with pytest.raises(AccessError) as error:
        access.connect(endpoint, 30.0, credentials)
    assert time.monotonic() - begun < 15, "a refusal is not waited for"
    return str(error.value)


def test_who_is_known_gets_in_and_others_are_told_why_not(guarded: str) -> None:
    access.connect(guarded, 5.0, Credentials("alice", "secret")).close()
    assert "give --user and --password-file" in refusal(guarded, Credentials())
    assert "'alice' with this password" in refusal(guarded, Credentials("alice", "wrong"))
    assert "'bob' with this password" in refusal(guarded, Credentials("bob", "secret"))


def test_a_run_that_begins_to_listen_is_waited_for(free_port: int) -> None:
    opened: list[zenoh.Session] = []

    def listen() -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{free_port}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        opened.append(zenoh.open(config))

    late = threading.Timer(0.7, listen)
    late.start()
    access.connect(f"tcp/127.0.0.1:{free_port}", 20.0).close()
    late.join()
    opened[0].close()


def test_silence_is_not_a_refusal(free_port: int) -> None:
    with pytest.raises(AccessError, match="nothing answers at"):
        access.connect(f"tcp/127.0.0.1:{free_port}", 0.5)


def test_what_hangs_up_is_a_refusal() -> None:
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
    access.add_arguments(parser.add_argument_group("who"))
    return parser.parse_args(arguments)


def test_passwords_are_read_from_files_that_others_cannot_read(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("pass word\n")
    file.chmod(0o644)
    with pytest.raises(AccessError, match="chmod 600"):
        access.of_options(options("--user", "alice", "--password-file", str(file)))
    file.chmod(0o600)
    credentials = access.of_options(options("--user", "alice", "--password-file", str(file)))
    assert (credentials.user, credentials.password) == ("alice", "pass word")
    file.write_text("\n")
    with pytest.raises(AccessError, match="is empty"):
        access.of_options(options("--user", "alice", "--password-file", str(file)))
    with pytest.raises(AccessError, match="go together"):
        access.of_options(options("--user", "alice"))
    with pytest.raises(AccessError, match="no such file"):
        access.of_options(options("--ca", str(tmp_path / "nowhere.pem")))


def test_commands_have_a_prefix_of_their_own() -> None:
    assert command.control_key(RunKey("a/b", 2)) == "caraware-control/a%2Fb/2"
