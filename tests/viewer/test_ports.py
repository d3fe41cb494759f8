"""Where the page is served, and to whom."""

import gzip
import socket
import sys
import urllib.error
import urllib.parse
import urllib.request

import pytest

from fluidlift import served as serving
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
    assert taken < found < taken + serving.TRIED
    with socket.socket() as mine:
        mine.bind(("127.0.0.1", found))


def test_where_no_port_is_free_the_message_says_which_were_tried(taken, monkeypatch):
    monkeypatch.setattr(serving, "TRIED", 1)
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
    ("origin", "host", "ours"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080", True), ("http://[::1]:8080", "[::1]:8080", True),
        ("http://localhost:9000", "localhost:9000", True),  # through a tunnel
        ("https://Fluid.example.org", "fluid.example.org", True), (None, "127.0.0.1:8080", True),
        ("http://127.0.0.1:9000", "127.0.0.1:8080", False), ("http://localhost:8080", "127.0.0.1:8080", False),
        ("http://example.org", "127.0.0.1:8080", False), ("http://127.0.0.1:8080.example.org", "127.0.0.1:8080", False),
        ("http://example.org/?http://127.0.0.1:8080", "127.0.0.1:8080", False), ("null", "127.0.0.1:8080", False),
        ("http://a@127.0.0.1:8080", "127.0.0.1:8080", False), ("file://", "", False), ("http://[", "[", False),
    ],
)  # fmt: skip
def test_pages_of_other_origins_are_told_from_ours(origin, host, ours):
    assert ports.same_origin(origin, host) is ours


def test_without_viser_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingPackage, match=r"pip install 'fluidlift\[view\]'"):
        ports.require_viser()


@pytest.fixture
def served():
    """A server: its address without the secret, and the secret."""
    pytest.importorskip("viser", reason="viser is not installed")
    server, secret = ports.open_server("127.0.0.1", ports.free_port("127.0.0.1"), "test")
    yield f"127.0.0.1:{server.get_port()}", secret, server
    server.stop()


def asked(address: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of an answer."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read()


def test_a_page_of_another_origin_cannot_open_a_connection(served):
    """A browser sends along whose page it is; any site, and any other port, could try 127.0.0.1."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    place, secret, server = served
    with connect(f"ws://{place}/{secret}", origin=f"http://{place}"):
        pass
    for origin in ("http://example.org", "http://127.0.0.1:1", "http://localhost:1"):
        with pytest.raises(InvalidStatus), connect(f"ws://{place}/{secret}", origin=origin):
            pass
    assert server.request_share_url() is None


def test_only_who_knows_the_address_is_let_in(served):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    place, secret, _ = served
    for path in ("", "/", f"/{secret}x/", f"/x/{secret}", f"/?{secret}", "/%2e%2e", f"/{secret[:-1]}", "/ä"):
        status, _, body = asked(f"http://{place}{urllib.parse.quote(path, safe='/%?')}")
        assert status == 403 and secret.encode() not in body, path
        with pytest.raises(InvalidStatus), connect(f"ws://{place}{urllib.parse.quote(path, safe='/%?')}"):
            pass
    status, _, body = asked(f"http://{place}/{secret}/?fixedDpr=1")
    assert status == 200 and b"<html" in body
    assert asked(f"http://{place}/{secret}")[0] == 200
    assert asked(f"http://{place}/{secret}/../../etc/passwd")[0] == 404


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_the_page_has_our_title_and_icon(served, encoding):
    place, secret, _ = served
    _, headers, body = asked(f"http://{place}/{secret}/?a=1", **{"Accept-Encoding": encoding})
    assert int(headers["Content-Length"]) == len(body)
    page = (gzip.decompress(body) if encoding == "gzip" else body).decode()
    assert "<title>fluidlift</title>" in page and "<title>Viser" not in page
    assert page.count(ports.ICON) == 1
    assert "</html>" in page


def test_no_other_page_may_show_this_one_in_a_frame(served):
    place, secret, _ = served
    headers = asked(f"http://{place}/{secret}/")[1]
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Referrer-Policy"] == "no-referrer"
