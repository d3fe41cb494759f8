"""The files of a job: where they are, and what is in them. Only the content counts in the keys of stages."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fluidlift.backends.model_cache import kept
from fluidlift.errors import InputRejected
from fluidlift.io.hashes import digest, file_hash

BESIDE = {"keyed": False}
"""metadata of a field that does not change the result of a stage: keys leave it out (`pipeline.runner`)"""
OF_CACHE = "model:"
"""what weights begin with that are a model of the user's cache: no file that lies about is taken for it"""
_OPTIONS = {"geometry": ("--geometry-from", "folder")}
"""option and what it takes, where they are not --name and a file"""


@dataclass(frozen=True)
class Inputs:
    """Files of a job. All but the clip are optional."""

    clip: Path
    mask: Path | None = None
    camera: Path | None = None
    depth: Path | None = None
    geometry: Path | None = None
    """folder of Gaussian PLY files and camera.json"""
    flow: Path | None = None
    """optical flow of the clip: a folder of .flo, .exr or .npz files, or one .npz"""

    def existing(self) -> dict[str, Path]:
        """Those that were given."""
        return {k: v for k, v in vars(self).items() if v is not None}


@dataclass(frozen=True)
class GivenFile:
    """A file or folder, and a hash of its content, which is what results depend on."""

    path: Path = field(metadata=BESIDE)
    content: str | list[str]
    """SHA-256; of numbered pictures one each"""


@dataclass(frozen=True)
class Weights:
    """Weights of a learned model, by their content where they are files here, else by their name."""

    name: str = field(metadata=BESIDE)
    """file, folder, or name on the hub: what a back end is given"""
    content: str
    model: str | None = field(default=None, metadata=BESIDE)
    """name of the model, where it is one of the user's cache"""

    @property
    def label(self) -> str:
        """Its name, without where it is."""
        return self.model or Path(self.name).name

    @property
    def files(self) -> dict[str, str]:
        """SHA-256 of each file; none of what is a name on the hub."""
        if self.model is not None:
            return dict(part.split(":") for part in self.content.split())
        path = Path(self.name)
        files = [path] if path.is_file() else sorted(p for p in path.glob("*") if p.is_file())
        return {file.name: digest(file) for file in files}

    @classmethod
    def of(cls, name: str | None) -> Weights | None:
        """Of a file, a folder, a model of the user's cache (model:NAME), or a name on the hub.

        Raises:
            InputRejected: a model that is not in the cache, or not what was fetched.
        """
        if name is None:
            return None
        if name.startswith(OF_CACHE):
            return cls._of_cache(name.removeprefix(OF_CACHE))
        path = Path(os.path.expanduser(name))
        return cls(str(path), file_hash(path)) if path.exists() else cls(name, name)

    @classmethod
    def _of_cache(cls, name: str) -> Weights:
        model = kept(name)
        if model is None:
            raise InputRejected(
                f"the model {name} is not in the cache of this machine", "one that is", f"fluidlift models get {name}"
            )
        model.require_whole()
        return cls(str(model.path), " ".join(f"{k}:{v}" for k, v in sorted(model.hashes.items())), name)


@dataclass(frozen=True)
class GivenFiles:
    """The files of a job with their hashes."""

    clip: GivenFile
    mask: GivenFile | None = None
    camera: GivenFile | None = None
    depth: GivenFile | None = None
    geometry: GivenFile | None = None
    flow: GivenFile | None = None

    @classmethod
    def of(cls, inputs: Inputs) -> GivenFiles:
        """Look at every file that was given.

        Raises:
            InputRejected: a file that is not there.
        """
        from fluidlift.io.limits import require_file
        from fluidlift.io.sequences import is_sequence, list_sequence

        if not is_sequence(inputs.clip):
            require_file(inputs.clip, "video")
        found: dict[str, GivenFile] = {}
        for name, path in inputs.existing().items():
            if path.exists():
                found[name] = GivenFile(path, file_hash(path))
            elif name == "clip":
                found[name] = GivenFile(path, [file_hash(p) for _, p in list_sequence(path)])
            elif name in ("flow", "mask") and is_sequence(path):  # a pattern
                found[name] = GivenFile(path, file_hash(path.parent))
            else:
                option, what = _OPTIONS.get(name, (f"--{name}", "file"))
                raise InputRejected(f"no such {name} {what}: '{path}'", f"an existing {what}", f"check {option}")
        return cls(**found)

    def provenance(self) -> dict[str, Any]:
        """Names and hashes, for a manifest."""
        given = {k: v for k, v in vars(self).items() if v is not None}
        return {"inputs": {k: {"name": v.path.name, "sha256": v.content} for k, v in given.items()}}
