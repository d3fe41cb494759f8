"""Assets on an object store, or on anything else that fsspec reaches by a URL such as s3://bucket/assets.

A shot is made in a folder of the machine that makes it, and what it leaves is put to the store then: files of the
asset, its manifest after the others, and what became of the shot last, so that a shot whose state is there is there as
a whole. Stores have no locks. Two batches that make one shot with the same options at the same time do its work twice,
and what they leave is either that of one of them, or counts as not finished and is made again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.farm.shots import Shot, is_name
from fluidlift.farm.state import LARGEST, LISTED, LOG, STATE, ShotOutcome, parsed_outcome, write_outcome
from fluidlift.farm.summary import PARQUET, SUMMARY, TABLE
from fluidlift.io.asset_paths import require_no_links
from fluidlift.io.atomic import write_bytes

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.ASCII)
_SECRET = re.compile(r"[^/]*//[^/]*:[^/]*@")
_MANIFEST = 64 << 20
"""bytes of a manifest that are read: one of 1500 frames has a megabyte"""
_LIST = 64 << 20
"""bytes of a list of names that are read: ten thousand take some hundred kilobytes"""
_AT_ONCE = 200
"""states that are asked for in one go: fsspec asks for them side by side, and they lie in memory together"""


def is_url(text: str) -> bool:
    """Whether an output is meant that is no folder of this machine."""
    return _URL.match(text) is not None


@dataclass(frozen=True)
class Store:
    """A place by its URL, and the folder in which each machine makes what is put there."""

    url: str
    scratch: Path | None = None
    """None: below the user's cache folder"""

    @property
    def folder(self) -> Path:
        """Of this machine: a folder of its own for every store, which only this user may enter."""
        name = hashlib.sha256(self.url.rstrip("/").encode()).hexdigest()[:16]
        base = self.scratch or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fluidlift" / "batch"
        folder = base.absolute() / name
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        return folder

    def where(self, name: str) -> str:
        """The URL of something on the store."""
        return f"{self.url.rstrip('/')}/{name}"

    def require(self) -> None:
        """See that it can be written, before hours of work are done for it.

        Raises:
            MissingPackage: what reaches such stores is not installed.
            InputRejected: it cannot be reached, or written.
        """
        name = f".looking.{uuid.uuid4().hex}"
        with self._errors("written"):
            fs, root = self._place()
            fs.makedirs(root, exist_ok=True)
            fs.pipe_file(f"{root}/{name}", b"x")
            fs.rm_file(f"{root}/{name}")

    def pull(self) -> None:
        """Have what is known of its shots in the folder of this machine: states, and the list of names.

        What is there too large, is a link, or is damaged counts as absent.

        Raises:
            InputRejected: it cannot be read.
        """
        folder = self.folder
        with self._errors("read"):
            fs, root = self._place()
            fs.invalidate_cache()
            listed = fs.ls(root, detail=True) if fs.exists(root) else []
            there = {PurePosixPath(e["name"]).name: e for e in listed}
            names = [n for n, e in there.items() if n.endswith(STATE) and _is_file(e, LARGEST)]
            names = [n for n in names if is_name(n.removesuffix(STATE))]
            gone = {p.name for p in folder.glob(f"*{STATE}")}
            for k in range(0, len(names), _AT_ONCE):
                paths = {f"{root}/{n}": n.removesuffix(STATE) for n in names[k : k + _AT_ONCE]}
                for path, data in fs.cat(list(paths), on_error="omit").items():
                    if (found := parsed_outcome(data, paths[path])) is not None:
                        write_outcome(folder, found)
                        gone.discard(f"{found.name}{STATE}")
            for old in gone:
                (folder / old).unlink(missing_ok=True)
        if (shots := self.read(LISTED, _LIST)) is not None:
            write_bytes(folder / LISTED, shots)

    def read(self, name: str, most: int) -> bytes | None:
        """A file of so many bytes at most; None where there is none, or a larger one, or a link.

        Raises:
            InputRejected: the store cannot be read.
        """
        with self._errors("read"):
            fs, root = self._place()
            fs.invalidate_cache()
            try:
                if not _is_file(fs.info(f"{root}/{name}"), most):
                    return None
                return fs.cat_file(f"{root}/{name}", 0, most)
            except FileNotFoundError:
                return None

    def put_files(self) -> None:
        """Put the summary and the list of names there, as they stand in the folder. Raises as `put_file`."""
        for name in (LISTED, SUMMARY, TABLE, PARQUET):
            self.put_file(name)

    def put_file(self, name: str) -> None:
        """Put a file of the folder there under its name; nothing where there is none.

        Raises:
            InputRejected: it cannot be written.
        """
        local = self.folder / name
        if not local.is_file() or local.is_symlink():
            return
        with self._errors("written"):
            fs, root = self._place()
            fs.put_file(str(local), f"{root}/{name}")

    def finished(self, shot: Shot) -> ShotOutcome | None:
        """What is known of a shot with which nothing is left to do: its state says so, and its manifest is that of the
        state. Raises as `read`."""
        found = self.read(f"{shot.name}{STATE}", LARGEST)
        known = None if found is None else parsed_outcome(found, shot.name)
        if known is None or not known.well or known.fingerprint != shot.fingerprint():
            return None
        manifest = self.read(f"{shot.name}.fluid/manifest.json", _MANIFEST)
        if manifest is None or hashlib.sha256(manifest).hexdigest() != known.manifest:
            return None
        now = replace(known, clip=str(shot.clip), licence=shot.licence, source=shot.source)
        if now != known:
            self._write_state(now)
        return now

    def put(self, outcome: ShotOutcome) -> ShotOutcome:
        """Put what a make left in the folder there; how that is known from then on.

        Args:
            outcome: of the make. Where the asset cannot be put there, the shot failed; it stays in the folder then, so
                that the next try has nothing to do but that.
        """
        name = outcome.name
        now = replace(outcome, asset=self.where(f"{name}.fluid"), log=self.where(f"{name}{LOG}"))
        try:
            with self._errors("written"):
                fs, root = self._place()
                if fs.exists(state := f"{root}/{name}{STATE}"):  # it speaks of what is replaced now
                    fs.rm_file(state)
            if outcome.well:
                self._put_asset(f"{name}.fluid")
        except FluidliftError as error:
            now = replace(now, outcome="failed", reason=" ".join(str(error).split()), failure="crash")
        with suppress(FluidliftError):
            self.put_file(f"{name}{LOG}")
        try:
            self._write_state(now)
        except FluidliftError as error:
            now = replace(now, outcome="failed", reason=" ".join(str(error).split()), failure="crash")
        return now

    def _put_asset(self, name: str) -> None:
        """All files of an asset, its manifest last, in the place of what is there."""
        local = self.folder / name
        require_no_links(local)
        files = sorted(f.relative_to(local).as_posix() for f in local.rglob("*") if f.is_file())
        files = [f for f in files if not PurePosixPath(f).name.startswith(".")]  # locks
        with self._errors("written"):
            fs, root = self._place()
            base = f"{root}/{name}"
            if _is_local(fs) and Path(base).exists():
                require_no_links(base)
            old = {path for path in fs.find(base) if path.startswith(f"{base}/")} if fs.exists(base) else set()
            for manifest in (False, True):
                for file in (f for f in files if (f == "manifest.json") is manifest):
                    fs.makedirs(f"{base}/{file}".rpartition("/")[0], exist_ok=True)
                    fs.put_file(str(local / file), f"{base}/{file}")
                if not manifest:
                    for path in old - {f"{base}/{file}" for file in files}:
                        fs.rm_file(path)

    def _write_state(self, outcome: ShotOutcome) -> None:
        with self._errors("written"):
            fs, root = self._place()
            fs.pipe_file(f"{root}/{outcome.name}{STATE}", (json.dumps(asdict(outcome), indent=1) + "\n").encode())

    def _place(self) -> tuple[Any, str]:
        """The file system and the path in it."""
        from fsspec.core import url_to_fs

        if _SECRET.match(self.url):
            raise InputRejected(
                "a password in the URL of a store", "one without: it would stand in states and logs",
                "give it in the environment, or in the settings of fsspec (~/.config/fsspec)",
            )  # fmt: skip
        if "::" in self.url:
            raise InputRejected(f"'{self.url}'", "a URL without ::", "name the store itself")
        fs, root = url_to_fs(self.url)
        root = root.rstrip("/")
        if not root:
            raise InputRejected(f"'{self.url}' is a whole store", "a place in it", f"{self.url.rstrip('/')}/assets")
        return fs, root

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Say what a store has against it: each has exceptions of its own."""
        try:
            yield
        except FluidliftError:
            raise
        except ImportError as error:
            raise MissingPackage(f"-o {self.url} needs what reaches it ({error}): pip install 'fluidlift[store]' "
                                 "and, for S3, s3fs; for Google, gcsfs; for Azure, adlfs") from None  # fmt: skip
        except Exception as error:
            told = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            raise InputRejected(
                f"'{self.url}' cannot be {what} ({told})", "a store that can be reached and written",
                "look at the address, at your rights there, and at the settings of fsspec",
            ) from None  # fmt: skip


def _is_file(entry: dict[str, Any], most: int) -> bool:
    """Whether an entry of a listing is a plain file of so many bytes at most."""
    return entry["type"] == "file" and not entry.get("islink") and 0 <= int(entry["size"] or 0) <= most


def _is_local(fs: Any) -> bool:
    protocol = fs.protocol if isinstance(fs.protocol, str) else "".join(fs.protocol)
    return "file" in protocol
