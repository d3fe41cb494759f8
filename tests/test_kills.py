"""A run that is killed at any moment loses nothing: the next one makes what an undisturbed one makes."""

from __future__ import annotations

import os
import random

import pytest
from kills import resumed, undisturbed


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return undisturbed(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("number", range(2))
def test_a_killed_run_is_resumed_to_the_same_bytes(whole, tmp_path, number):
    seed = int.from_bytes(os.urandom(4))
    print(f"seed {seed}")  # another one each time; shown where this fails
    outcome = resumed(whole, tmp_path / "a.fluid", random.Random(seed), kills=2)
    assert outcome.different == [], outcome.said
    assert outcome.left == []
