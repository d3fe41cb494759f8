"""Seconds that the largest YAML texts take, to be read or refused.

python benchmarks/yaml_reader.py
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import yaml

from fluidlift.io.yaml_reader import MAX_BYTES, MAX_NODES, composed, parse_yaml

TEXTS = {
    "as many entries as are taken": "\n".join(f"k{k}: 1" for k in range(MAX_NODES // 2 - 1)),
    "a list of ones": "[" + "1," * (MAX_BYTES // 2 - 1) + "]",
    "braces": "a: " + "{" * 900_000,
    "one comment": "#" * MAX_BYTES,
    "line breaks in a text": "a: '" + "\n" * (MAX_BYTES - 10) + "'",
}


def seconds(read: Callable[[str], object], text: str) -> float:
    """Of one reading; composed nodes are not taken from before."""
    composed.cache_clear()
    began = time.perf_counter()
    with contextlib.suppress(yaml.YAMLError, RecursionError):
        read(text)
    return time.perf_counter() - began


def main() -> None:
    """Print a line per text."""
    for name, text in TEXTS.items():
        ours = min(seconds(parse_yaml, text) for _ in range(3))
        print(f"{name:30} {len(text):8} bytes: {ours:.2f} s", flush=True)


if __name__ == "__main__":
    main()
