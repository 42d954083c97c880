"""The peers of `caraware bench ipc`: one-way latency of the usual ways to send arrays between Python programs.

`python -m caraware_bench.ipc_peers SIZES FILE` sends messages of each size (bytes, comma-separated) from one
process to another through a pipe of `multiprocessing`, a TCP connection over loopback and, if pyzmq is installed,
ZeroMQ's `ipc://`, and writes `{peer: {size: [latency_ns, …]}}`. Each receives asleep, until the kernel wakes it, and
polling: it asks again and again without a pause. The sender writes the monotonic time into a message
right before it sends; the receiver reads the clock once the message is a tensor. One message is under way at a time.
"""

import contextlib
import importlib.util
import json
import multiprocessing
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import torch

PIPE, TCP, ZMQ = "multiprocessing pipe", "TCP over loopback", "pyzmq ipc://"
POLLS = ", polling"
"""End of the name of a peer that polls; the page of the benchmarks compares it with ours that polls."""

STAMP = struct.Struct("<Q")
WARM_UP = 20
PAUSE_S = 200e-6

Receive = Callable[[int], "bytes | bytearray | memoryview"]
Send = Callable[[bytearray], None]


def tensor_of(message: bytes | bytearray | memoryview) -> torch.Tensor:
    """A tensor over the floats of a message, without a copy."""
    return torch.from_numpy(np.frombuffer(message, dtype=np.float32))


def messages_of(size: int) -> int:
    """Number of messages to measure: fewer for large sizes."""
    return max(50, min(1000, (64 << 20) // size))


def pipe_receiver(connection: Connection, polls: bool) -> Receive:
    """Receive from a `multiprocessing.Pipe` with `Connection.recv_bytes`."""

    def receive(_: int) -> bytes:
        while polls and not connection.poll():
            pass
        return connection.recv_bytes()

    return receive


def tcp_receiver(port_pipe: Connection, polls: bool) -> Receive:
    """Receive from a TCP connection over loopback into one buffer. The sender switches Nagle's delay off."""
    listener = socket.create_server(("127.0.0.1", 0))
    port_pipe.send(listener.getsockname()[1])
    stream, _ = listener.accept()
    stream.setblocking(not polls)
    buffers: dict[int, bytearray] = {}

    def receive(size: int) -> memoryview:
        view = memoryview(buffers.setdefault(size, bytearray(size)))
        got = 0
        while got < size:
            with contextlib.suppress(BlockingIOError):
                got += stream.recv_into(view[got:])
        return view

    return receive


def zmq_receiver(address: str, polls: bool) -> Receive:
    """Receive from a ZeroMQ PULL socket without copying the message out of its frame."""
    import zmq

    receiver = zmq.Context().socket(zmq.PULL)
    receiver.connect(address)

    def receive(_: int) -> memoryview:
        while polls:
            with contextlib.suppress(zmq.Again):
                polled: memoryview = receiver.recv(zmq.NOBLOCK, copy=False).buffer
                return polled
        message: memoryview = receiver.recv(copy=False).buffer
        return message

    return receive


def receiving(kind: str, address: str, sizes: list[int], connection: Connection, answer: Connection) -> None:
    """Run the receiving process: receive all messages, then send all latencies."""
    polls, kind = kind.endswith(POLLS), kind.removesuffix(POLLS)
    receive = {
        PIPE: lambda: pipe_receiver(connection, polls),
        TCP: lambda: tcp_receiver(answer, polls),
        ZMQ: lambda: zmq_receiver(address, polls),
    }[kind]()
    answer.send("ready")
    latencies: dict[int, list[int]] = {}
    for size in sizes:
        latencies[size] = []
        for _ in range(WARM_UP + messages_of(size)):
            message = receive(size)
            tensor = tensor_of(message)
            now_ns = time.monotonic_ns()
            assert tensor.numel() * 4 == size
            latencies[size].append(now_ns - STAMP.unpack_from(message)[0])
            answer.send_bytes(b"taken")
        del latencies[size][:WARM_UP]
    answer.send(latencies)


def measure(kind: str, sizes: list[int]) -> dict[int, list[int]]:
    """Measure all latencies of one peer, by size."""
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    answer, their_answer = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory() as directory:
        address = f"ipc://{directory}/socket"
        if kind.startswith(ZMQ):
            import zmq

            socket_ = zmq.Context().socket(zmq.PUSH)
            socket_.bind(address)
        arguments = (kind, address, sizes, theirs, their_answer)
        process = context.Process(target=receiving, args=arguments, daemon=True)
        process.start()
        send: Send
        if kind.startswith(PIPE):
            send = ours.send_bytes
        elif kind.startswith(TCP):
            stream = socket.create_connection(("127.0.0.1", answer.recv()))
            stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            send = stream.sendall
        else:
            # pyzmq sends the buffer without a copy. The next write waits until the receiver has taken the message.
            send = lambda message: socket_.send(message, copy=False)  # noqa: E731
        assert answer.recv() == "ready"
        for size in sizes:
            message = bytearray(size)
            for _ in range(WARM_UP + messages_of(size)):
                time.sleep(PAUSE_S)
                STAMP.pack_into(message, 0, time.monotonic_ns())
                send(message)
                answer.recv_bytes()
        latencies: dict[int, list[int]] = answer.recv()
        process.join()
    return latencies


def main() -> None:
    """Measure every installed peer and write the latencies."""
    sizes = [int(size) for size in sys.argv[1].split(",")]
    kinds = [PIPE, TCP]
    if importlib.util.find_spec("zmq"):
        kinds.append(ZMQ)
    kinds += [kind + POLLS for kind in kinds]
    Path(sys.argv[2]).write_text(json.dumps({kind: measure(kind, sizes) for kind in kinds}))


if __name__ == "__main__":
    main()
