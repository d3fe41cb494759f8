"""A change that is to change no result changes no byte of four assets: the demo, a stream, a dam and a plume.

The bytes hold for one kind of processor and one set of versions; elsewhere `python tests/catalogue.py --against REV`
compares with another commit on the same machine.
"""

import json

import pytest
from catalogue import RECIPES, RECORDED, digests, fingerprint


@pytest.mark.parametrize("name", RECIPES)
def test_an_asset_comes_out_with_the_same_bytes(name, catalogue_asset):
    recorded = json.loads(RECORDED.read_text(encoding="utf-8"))
    if fingerprint() not in recorded:
        pytest.skip(f"bytes are not recorded for this machine: {fingerprint()}; see tests/catalogue.py")
    assert digests(catalogue_asset(name).folder) == recorded[fingerprint()][name]
