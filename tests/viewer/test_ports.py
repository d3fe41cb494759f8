"""Where the page is served, and to whom."""

import re
import socket
import sys

import pytest

from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.viewer import ports


@pytest.fixture
def taken():
    """A port that somebody listens on."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield server.getsockname()[1]


def test_a_port_in_use_gives_the_next_free_one(taken):
    found = ports.free_port("127.0.0.1", taken)
    assert taken < found < taken + ports.TRIED
    with socket.socket() as mine:
        mine.bind(("127.0.0.1", found))


def test_where_no_port_is_free_the_message_says_which_were_tried(taken, monkeypatch):
    monkeypatch.setattr(ports, "TRIED", 1)
    with pytest.raises(InputRejected, match=rf"no free port from {taken} to {taken}.*--port"):
        ports.free_port("127.0.0.1", taken)


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_a_port_that_does_not_exist_is_refused(port):
    with pytest.raises(InputRejected, match="1 to 65535"):
        ports.free_port("127.0.0.1", port)


def test_an_address_that_is_not_of_this_machine_is_refused():
    with pytest.raises(InputRejected):
        ports.free_port("not a host", 8080)


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False), ("192.168.1.7", False), ("a", False)],
)
def test_only_loopback_addresses_count_as_this_machine(host, local):
    assert ports.is_local(host) is local


@pytest.mark.parametrize(
    ("origin", "ours"),
    [
        ("http://127.0.0.1:8080", True), ("http://localhost:9000", True), ("http://[::1]:80", True),
        ("http://example.org", False), ("http://localhost.example.org:8080", False),
        ("http://127.0.0.1.example.org", False), ("http://example.org/?http://localhost:8080", False),
    ],
)  # fmt: skip
def test_pages_of_other_sites_are_told_from_ours(origin, ours):
    assert bool(re.fullmatch(ports.LOCAL_PAGES, origin)) is ours


def test_without_viser_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingPackage, match=r"pip install 'fluidlift\[view\]'"):
        ports.require_viser()


def test_a_page_of_another_site_cannot_open_a_connection():
    """A browser sends along whose page it is; any site could try 127.0.0.1."""
    pytest.importorskip("viser", reason="viser is not installed")
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    server = ports.open_server("127.0.0.1", ports.free_port("127.0.0.1"), "test")
    try:
        address = f"ws://127.0.0.1:{server.get_port()}"
        with connect(address, origin=f"http://127.0.0.1:{server.get_port()}"):
            pass
        with pytest.raises(InvalidStatus), connect(address, origin="http://example.org"):
            pass
        assert server.request_share_url() is None
    finally:
        server.stop()
