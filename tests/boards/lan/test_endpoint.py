"""Endpoints: which texts are one, what each part is, and who can reach it."""

from __future__ import annotations

import pytest

from rack.boards.lan.endpoint import Endpoint


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("tcp/127.0.0.1:1", ("tcp", "127.0.0.1", 1)),
        ("tls/robot-1.lab:65535", ("tls", "robot-1.lab", 65535)),
        ("quic/[fe80::1]:7447", ("quic", "fe80::1", 7447)),
        ("tcp/3com:80", ("tcp", "3com", 80)),
        ("unix/cell-puma", ("unix", "cell-puma", 0)),
    ],
)
def test_an_endpoint_has_a_protocol_a_host_and_a_port(
    text: str, parts: tuple[str, str, int]
) -> None:
    assert Endpoint.from_text(text) == parts
    assert str(Endpoint.from_text(text)) == text


@pytest.mark.parametrize(
    "text",
    [
        *("udp/a:1", "tcp/a", "tcp/a:", "tcp/a:0", "tcp/a:65536", "tcp/a:1 ", "tcp/:1", "tcp/ü:1"),
        *("", "a:1", "tcp/a:1?rel=0", "tcp/a b:1", "tcp/2130706433:1"),
        *("unix/", "unix/../cell", "unix//tmp/cell", "unix/cell:1"),
        # Resolvers would take these for addresses.
        *("tcp/127.1:1", "tcp/300:1", "tcp/1.2.3.400:1", "tcp/[1::2::3]:1"),
    ],
)
def test_a_malformed_endpoint_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="must be tcp/, tls/ or quic/"):
        Endpoint.from_text(text)


@pytest.mark.parametrize(
    ("host", "is_loopback", "is_everywhere"),
    [
        ("localhost", True, False),
        ("127.9.9.9", True, False),
        ("[::1]", True, False),
        ("0.0.0.0", False, True),
        ("[::]", False, True),
        ("10.0.0.1", False, False),
        ("localhost.lab", False, False),
    ],
)
def test_an_endpoint_knows_who_can_reach_it(
    host: str, is_loopback: bool, is_everywhere: bool
) -> None:
    endpoint = Endpoint.from_text(f"tcp/{host}:7447")
    assert (endpoint.is_loopback, endpoint.is_wildcard) == (is_loopback, is_everywhere)


def test_which_protocols_have_certificates() -> None:
    found = {name: Endpoint(name, "a", 1).has_tls for name in ("tcp", "tls", "quic")}
    assert found == {"tcp": False, "tls": True, "quic": True}
