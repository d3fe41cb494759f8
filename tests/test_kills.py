"""A run that is killed at any moment loses nothing: the next one makes what an undisturbed one makes."""

from __future__ import annotations

import os
import random

import pytest
from kills import resumed, undisturbed


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return undisturbed(tmp_path_factory.mktemp("whole"))


def test_a_run_that_is_killed_three_times_comes_to_the_same_bytes(whole, tmp_path):
    seed = int.from_bytes(os.urandom(4))
    print(f"seed {seed}")  # another one each time; shown where this fails
    outcome = resumed(whole, tmp_path / "a.fluid", random.Random(seed), kills=3)
    assert outcome.different == [], outcome.said
    assert outcome.left == []
