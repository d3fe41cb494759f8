"""One file from a server or a disk: bounded, hashed as it comes, gone on with where it was cut, no link followed."""

from __future__ import annotations

import errno
import hashlib
import http.client
import os
import stat
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from fluidlift import __version__
from fluidlift.backends.model_cache import ELSEWHERE
from fluidlift.backends.model_card import ModelFile
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.atomic import disk_errors

Told = Callable[[int, int | None], None]
"""called with (bytes there, bytes in all where that is known)"""

BLOCK = 2**20
"""bytes at a time: few calls, and no more memory than that"""
REDIRECTS = 5
"""hubs lead to their storage by one or two"""
LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class Transport:
    """How files are fetched."""

    plain_loopback: bool = False
    """whether http will do to this machine itself: for tests, never for users"""
    timeout: float = 30.0
    """s of silence"""
    tries: int = 4
    """connections per file; a cut one is gone on with"""
    pause: float = 1.0
    """s before the second try; each further one waits twice as long"""

    def allows(self, address: str) -> bool:
        """Whether an address may be asked, the first one or one that a server leads to."""
        parts = urllib.parse.urlsplit(address)
        if parts.scheme == "https" and parts.hostname:
            return True
        return self.plain_loopback and parts.scheme == "http" and parts.hostname in LOOPBACK


HTTPS = Transport()


class _Cut(Exception):
    """The connection ended before the file did."""


def fetch(file: ModelFile, target: Path, transport: Transport = HTTPS, told: Told = lambda done, total: None) -> str:
    """Download a file, or the rest of it, to `target`; its SHA-256.

    What an earlier run left in `target` is gone on with where the hash of the whole is known, which tells whether the
    parts belong together; else it is fetched anew. Nothing is sent but the address, the range and fluidlift's version.
    Proxies are those of the environment (`https_proxy`).

    Args:
        file: of a model.
        target: a file or nothing, never a link.
        transport: limits of the network.
        told: hears how far it is.

    Raises:
        InputRejected: the server has another file than the one that is known, or more than it may; a full disk.
        FluidliftError: no network, or the server refuses; what came so far is kept.
    """
    opener = urllib.request.build_opener(_Redirects(transport))
    for attempt in range(transport.tries):
        if attempt:
            time.sleep(transport.pause * 2 ** (attempt - 1))
        try:
            with disk_errors(target, ELSEWHERE), _opened(target, fresh=file.sha256 is None) as out:
                return _received(file, out, opener, transport, told)
        except _Cut as cut:
            reason = str(cut)
        except urllib.error.HTTPError as error:
            raise _refused(file, error) from None
        except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
            reason = str(getattr(error, "reason", error)) or type(error).__name__
    kept = "what came is kept, and the same command goes on; or " if file.sha256 is not None else ""
    raise FluidliftError(
        f"'{file.name}' could not be fetched ({' '.join(reason.split())[:160]}). Needed: a connection to "
        f"{urllib.parse.urlsplit(file.address).hostname}. Do: check the network and https_proxy: {kept}"
        f"fetch {file.address} elsewhere and bring it with --from."
    )


def copy(file: ModelFile, source: Path, target: Path, told: Told = lambda done, total: None) -> str:
    """Copy a file that was brought by hand to `target`; its SHA-256.

    Raises:
        InputRejected: no such file, a link or something else that is no plain file, or another size than is known.
    """
    try:
        read = os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputRejected(f"'{source}' is a link", "the file itself", "copy it with cp -L first") from None
        raise InputRejected(
            f"'{source}' cannot be read ({error.strerror})", f"the file {file.name}", "check --from"
        ) from None
    with os.fdopen(read, "rb") as held:
        facts = os.fstat(held.fileno())
        if not stat.S_ISREG(facts.st_mode):
            raise InputRejected(f"'{source}' is no plain file", f"the file {file.name}", "check --from")
        _require_size(file, facts.st_size, f"'{source.name}'")
        try:
            with disk_errors(target, ELSEWHERE), _opened(target, fresh=True) as out:
                return _poured(file, held, out, hashlib.sha256(), facts.st_size, told)
        except _Cut:
            raise InputRejected(f"'{source}' became shorter while it was read", "a file at rest") from None


@contextmanager
def _opened(path: Path, *, fresh: bool) -> Iterator[IO[bytes]]:
    """A file to write, made here or left by an earlier run, and in no case what a link leads to."""
    if fresh:
        path.unlink(missing_ok=True)  # of a link: the link
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        number = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        try:
            number = os.open(path, flags)
        except OSError as error:
            raise InputRejected(
                f"'{path}' is in the way ({error.strerror})", "a plain file or nothing", "delete it"
            ) from None
    with os.fdopen(number, "r+b") as file:
        facts = os.fstat(number)
        if not stat.S_ISREG(facts.st_mode) or facts.st_nlink != 1:
            raise InputRejected(f"'{path}' is in the way (not a plain file of its own)", "nothing there", "delete it")
        yield file


def _received(file: ModelFile, out: IO[bytes], opener: Any, transport: Transport, told: Told) -> str:
    """One connection: the rest of the file, after what is there."""
    found, have = hashlib.sha256(), 0
    while block := out.read(BLOCK):
        found.update(block)
        have += len(block)
    if file.bytes is not None and have == file.bytes:
        return found.hexdigest()
    if have > file.most:
        found, have = _emptied(out), 0
    if not transport.allows(file.address):
        raise InputRejected(f"the address {file.address}", "https")
    headers = {"User-Agent": f"fluidlift/{__version__}", "Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
    request = urllib.request.Request(file.address, headers=headers)
    try:
        answer = opener.open(request, timeout=transport.timeout)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not have:
            raise
        _emptied(out)  # what is there is no beginning of it
        raise _Cut("the server has less than what came") from None
    with answer:
        if have and (answer.status != 206 or not _begins_at(answer, have)):
            found, have = _emptied(out), 0
            if answer.status == 206:
                raise _Cut("the server sent another part than it was asked for")
        length = answer.headers.get("Content-Length", "")
        total = have + int(length) if length.isdecimal() else file.bytes
        if total is not None:
            _require_size(file, total, f"the server's '{file.name}'")
        return _poured(file, answer, out, found, total, told, have)


def _poured(
    file: ModelFile, source: Any, out: IO[bytes], found: Any, total: int | None, told: Told, have: int = 0
) -> str:
    """The blocks of a source, written and hashed; never more than the file may have."""
    while True:
        block = source.read(BLOCK)
        if not block:
            break
        have += len(block)
        if have > file.most or (total is not None and have > total):
            _emptied(out)
            raise InputRejected(
                f"'{file.name}' has more than the {total or file.most} bytes that it was to have", "the known file",
                "try again later, or bring it with --from",
            )  # fmt: skip
        out.write(block)
        found.update(block)
        told(have, total)
    out.flush()
    if total is not None and have < total:
        raise _Cut(f"the connection ended after {have} of {total} bytes")
    os.fsync(out.fileno())
    return found.hexdigest()


def _emptied(out: IO[bytes]) -> Any:
    out.seek(0)
    out.truncate()
    return hashlib.sha256()


def _begins_at(answer: Any, have: int) -> bool:
    return answer.headers.get("Content-Range", "").startswith(f"bytes {have}-")


def _require_size(file: ModelFile, size: int, what: str) -> None:
    if file.bytes is not None and size != file.bytes:
        raise InputRejected(
            f"{what} has {size} bytes", f"the known file of {file.bytes} bytes",
            f"fetch it from {file.address}" if file.address else "take another one",
        )  # fmt: skip
    if size > file.most:
        raise InputRejected(f"{what} has {size} bytes", f"at most {file.most} bytes of a file whose size is not known")


def _refused(file: ModelFile, error: urllib.error.HTTPError) -> FluidliftError:
    """What the server's answer means."""
    why = {
        401: "it is handed out to those who asked for it", 403: "it is handed out to those who asked for it, or a "
        "firewall forbids it", 404: "it is not there any more", 429: "too many have asked; try again later",
    }.get(error.code, "try again later")  # fmt: skip
    return FluidliftError(
        f"The server answers {error.code} for '{file.name}' ({why}). Needed: {file.address}. "
        "Do: fetch it in a browser and bring it with --from."
    )


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows a server that leads elsewhere, as long as that is https as well."""

    max_redirections = REDIRECTS

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        """The request to the new address.

        Raises:
            InputRejected: it is not https.
        """
        if not self._transport.allows(newurl):
            raise InputRejected(
                f"the server leads to {urllib.parse.urlsplit(newurl).scheme}://, which is not secure", "https",
                "try again later, or bring the file with --from",
            )  # fmt: skip
        return super().redirect_request(req, fp, code, msg, headers, newurl)
