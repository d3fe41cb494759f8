"""A small server on this machine that hands out files, and can misbehave: for tests of downloads."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Files:
    """What is handed out, and how."""

    def __init__(self) -> None:
        self.contents: dict[str, bytes] = {}
        self.asked: list[tuple[str, str | None]] = []
        """path and Range of each request"""
        self.cuts: list[int] = []
        """bytes after which the next connections end"""
        self.redirect: str | None = None
        """where everything is said to be"""
        self.status: int | None = None
        """answered to everything"""
        self.knows_ranges = True
        self.tells_length = True
        self.address = ""

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        """Hand out what is asked for."""
        span = request.headers.get("Range")
        self.asked.append((request.path, span))
        data = self.contents.get(request.path.lstrip("/"))
        status = self.status or (302 if self.redirect else 404 if data is None else 200)
        if data is None or status != 200:
            request.send_response(status)
            if self.redirect:
                request.send_header("Location", self.redirect)
            request.send_header("Content-Length", "0")
            request.end_headers()
            return
        begin = int(span.removeprefix("bytes=").partition("-")[0]) if span and self.knows_ranges else 0
        if span and self.knows_ranges and begin >= len(data):
            request.send_response(416)
            request.send_header("Content-Length", "0")
            request.end_headers()
            return
        request.send_response(206 if begin else 200)
        if begin:
            request.send_header("Content-Range", f"bytes {begin}-{len(data) - 1}/{len(data)}")
        if self.tells_length:
            request.send_header("Content-Length", str(len(data) - begin))
        request.end_headers()
        part = data[begin:]
        request.wfile.write(part[: self.cuts.pop(0)] if self.cuts else part)


@contextmanager
def file_server() -> Iterator[Files]:
    """Serve files at `Files.address` while the block runs."""
    files = Files()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:  # a name of http.server
            files.answer(self)

        def log_message(self, format: str, *args: object) -> None:
            """Nobody reads along."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    files.address = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield files
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
