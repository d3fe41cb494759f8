"""A data set of assets: an index in Parquet with a row per asset, and what its rows name as arrays.

    for sample in samples("assets/", where=lambda row: row["kind"] == "stream" and row["verdict"] == "good"):
        sample.frames, sample.gaussians, sample.velocity, sample.parameters

The index needs pyarrow: `pip install 'fluidlift[dataset]'`.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.errors import InputRejected
from fluidlift.farm.state import ShotOutcome
from fluidlift.io.asset_folder import load_asset, read_manifest, read_parameters
from fluidlift.types import FluidParameters, Gaussians, kind_of

INDEX = "dataset.parquet"

COLUMNS: dict[str, tuple[str, str]] = {
    "name": ("string", "of the shot"),
    "asset": ("string", "its folder, from where the index lies"),
    "clip": ("string", "as the list named it"),
    "clip_sha256": ("string", "of its name and content, as the manifest has it; nothing for a pattern of pictures"),
    "licence": ("string", "of the clip, as the list gives it"),
    "source": ("string", "of the clip, as the list gives it"),
    "kind": ("string", "of the fluid"),
    "kind_probability": ("double", "0 to 1; nothing where it was given"),
    "verdict": ("string", "as filmed: good, usable, does not hold; empty: not measured"),
    "warnings": ("list", "codes"),
    "preset": ("string", "draft, standard or hero"),
    "version": ("string", "of fluidlift"),
    "frames": ("int64", "that were simulated"),
    "interval": ("double", "s between frames"),
    "cells_x": ("int64", "of the grid"),
    "cells_y": ("int64", "of the grid"),
    "cells_z": ("int64", "of the grid"),
    "spacing": ("double", "m, width of a cell"),
    "gaussians": ("int64", "of the body at rest"),
    "across": ("double", "m across the fluid"),
    "scale_from": ("string", "where the size comes from"),
    "scale_error": ("double", "relative error of the size; nothing where it is not known"),
    "pitch": ("double", "degrees that the camera looks down"),
    "roll": ("double", "degrees"),
    "up_error": ("double", "degrees by which up may be off"),
    "seconds": ("double", "that making it took"),
    "peak_memory_mb": ("double", "MB"),
}
"""Columns of every index: type and meaning. Then, of each parameter P: P, P_low and P_high (95 %), P_fitted; of each
figure F of the card: filmed_F."""


@dataclass(frozen=True)
class Sample:
    """One asset as arrays."""

    row: dict[str, Any]
    """of the index"""
    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB: of the clip where it lies at its place with its content, else the film of the fluid in the asset; of smoke
    none, whose film is its color and opacity"""
    of_clip: bool
    """whether the frames are the clip's"""
    gaussians: Gaussians
    """of the body at rest, world, m"""
    velocity: Float[np.ndarray, "nx ny nz 3"]
    """m/s, at the middles of the cells"""
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    """`types.CellType`"""
    parameters: FluidParameters


def require_parquet() -> None:
    """Raise `InputRejected` where no index can be written or read."""
    if importlib.util.find_spec("pyarrow") is None:
        raise InputRejected("a data set without pyarrow", "the package", "pip install 'fluidlift[dataset]'")


def write_index(folder: Path, outcomes: tuple[ShotOutcome, ...]) -> tuple[Path, int]:
    """Write dataset.parquet into a folder of shots: a row per asset that is whole; the path, and how many rows.

    Args:
        folder: of the batch.
        outcomes: of its shots; those that became no asset have no row.

    Raises:
        InputRejected: no pyarrow, or the folder cannot be written.
    """
    require_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    from fluidlift.io.atomic import atomic_path

    rows = [row_of(folder, outcome) for outcome in outcomes if outcome.well]
    more = sorted({name for row in rows for name in row} - set(COLUMNS))
    fields = [_field(name, kind, text) for name, (kind, text) in COLUMNS.items()]
    fields += [_field(name, "bool" if name.endswith("_fitted") else "double", "") for name in more]
    schema = pa.schema(fields, metadata={"fluidlift": "data set 1"})
    with atomic_path(folder / INDEX) as path:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), path)
    return folder / INDEX, len(rows)


def _field(name: str, kind: str, text: str) -> Any:
    import pyarrow as pa

    types = {"string": pa.string(), "double": pa.float64(), "int64": pa.int64(), "bool": pa.bool_(),
             "list": pa.list_(pa.string())}  # fmt: skip
    return pa.field(name, types[kind], metadata={"meaning": text} if text else None)


def row_of(folder: Path, outcome: ShotOutcome) -> dict[str, Any]:
    """What the index says of an asset; columns as `COLUMNS`, and its parameters and figures."""
    place = folder / f"{outcome.name}.fluid"
    manifest = read_manifest(place)
    metrics, config = manifest.get("metrics", {}), manifest.get("provenance", {}).get("config", {})
    clip = manifest.get("provenance", {}).get("inputs", {}).get("clip") or {}
    card, simulation = manifest.get("simulation", {}).get("as_filmed") or {}, manifest.get("simulation", {})
    scale, up, grid = metrics.get("scale") or {}, metrics.get("up") or {}, manifest["grid"]
    codes = [*manifest.get("warning_codes", ()), *simulation.get("warning_codes", ())]
    row: dict[str, Any] = {
        "name": outcome.name, "asset": place.name, "clip": outcome.clip,
        "clip_sha256": content if isinstance(content := clip.get("sha256"), str) else None,
        "licence": outcome.licence, "source": outcome.source, "kind": manifest["kind"],
        "kind_probability": (metrics.get("kind_scores") or {}).get(manifest["kind"]),
        "verdict": outcome.verdict or card.get("verdict") or "", "warnings": sorted(set(codes)),
        "preset": config.get("preset"), "version": outcome.version, "frames": simulation.get("frames"),
        "interval": manifest["frame_interval"], "spacing": grid["spacing"], "gaussians": metrics.get("gaussians"),
        "across": scale.get("across"), "scale_from": scale.get("source"), "scale_error": scale.get("relative_error"),
        "pitch": up.get("pitch"), "roll": up.get("roll"), "up_error": up.get("error"),
        "seconds": outcome.seconds, "peak_memory_mb": outcome.peak_memory_mb,
    }  # fmt: skip
    row |= dict(zip(("cells_x", "cells_y", "cells_z"), grid["shape"], strict=True))
    _, estimates = read_parameters(place / "parameters.json")
    for name, estimate in estimates.items():
        low, high = estimate.interval or (None, None)
        row |= {name: estimate.value, f"{name}_low": low, f"{name}_high": high, f"{name}_fitted": estimate.fitted}
    return row | {f"filmed_{name}": figure["value"] for name, figure in card.get("figures", {}).items()}


def read_index(folder: Path | str) -> list[dict[str, Any]]:
    """The rows of a data set, in the order of its list.

    Raises:
        InputRejected: no index, a damaged one, or no pyarrow.
    """
    require_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(folder) / INDEX
    if not path.is_file():
        raise InputRejected(f"no {INDEX} in '{folder}'", "a folder of assets with one",
                            "fluidlift batch FOLDER --status --dataset")  # fmt: skip
    try:
        return pq.read_table(path).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise InputRejected(f"'{path}': {str(error).splitlines()[0]}", "an index that fluidlift wrote") from None


def samples(folder: Path | str, where: Callable[[dict[str, Any]], bool] = lambda row: True) -> Iterator[Sample]:
    """The assets of a data set as arrays, one at a time.

    Args:
        folder: with the index.
        where: which rows.

    Raises:
        InputRejected: as `read_index`; an asset that is missing or damaged.
    """
    folder = Path(folder)
    for row in read_index(folder):
        if where(row):
            yield sample_of(folder, row)


def sample_of(folder: Path, row: dict[str, Any]) -> Sample:
    """The asset of one row."""
    from fluidlift.farm.shots import is_name

    name = row.get("asset")
    if not isinstance(name, str) or not is_name(name):
        raise InputRejected(f"the asset '{name}' of the index", "the name of a folder beside it")
    place = folder / name
    asset = load_asset(place)
    frames = _clip_of(place, row)
    if frames is not None:
        seen, of_clip = frames, True
    else:
        seen, of_clip = _film_of(place, asset.camera.size), False
    return Sample(row, seen, of_clip, asset.rest, asset.velocity.at_centers(), asset.cell_types, asset.parameters)


def _clip_of(place: Path, row: dict[str, Any]) -> np.ndarray | None:
    """The frames that make read; None where the clip is not there, or is another one."""
    from fluidlift.io.bars import between_bars
    from fluidlift.io.hashes import file_hash
    from fluidlift.io.video import read_clip

    path = Path(row["clip"] or "")
    if not path.is_file() or file_hash(path) != row["clip_sha256"]:
        return None
    read = read_manifest(place)["provenance"]["config"]["read"]
    decode = partial(
        read_clip, path, start=read["start"], duration=read["duration"], max_size=read["max_size"], fps=read["fps"]
    )
    return (between_bars(decode)[0] if read.get("crop") == "auto" else decode()).frames


def _film_of(place: Path, size: tuple[int, int]) -> np.ndarray:
    from fluidlift.io.footage_file import read_footage, size_of_film
    from fluidlift.scene.build import film_of

    film = film_of(place)
    if film is None or kind_of(read_manifest(place)["kind"]).is_gas:  # of smoke it is color and opacity, no picture
        width, height = size_of_film(size)
        return np.zeros((0, height, width, 3), np.uint8)
    return read_footage(film, size)[0]
