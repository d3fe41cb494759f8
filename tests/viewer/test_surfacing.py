"""Surfaces made beside the drawing thread: the newest wish first, errors told."""

import threading

import numpy as np

from fluidlift.errors import MissingPackage
from fluidlift.types import TriangleMesh
from fluidlift.viewer.surfacing import Surfacer

TRIANGLE = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))


def test_of_many_wishes_the_newest_is_made_and_those_between_are_left_out():
    began, go, done, made = threading.Event(), threading.Event(), threading.Semaphore(0), []

    def mesh(positions, radius):
        made.append(len(positions))
        began.set()
        go.wait(60)
        return TRIANGLE

    surfacer = Surfacer(done.release, lambda: mesh)
    frames = [object() for _ in range(4)]
    surfacer.ask(frames[0], np.zeros((1, 3)), 0.1)
    assert began.wait(60)
    for k in (1, 2, 3, 3):  # the last one twice: it is made once
        surfacer.ask(frames[k], np.zeros((k + 1, 3)), 0.1)
    go.set()
    assert done.acquire(timeout=60) and done.acquire(timeout=60)
    assert made == [1, 4]
    assert surfacer.made == (frames[3], TRIANGLE, "")


def test_what_cannot_be_made_is_told_and_what_is_not_wanted_any_more_is_not_kept():
    done, go = threading.Semaphore(0), threading.Event()

    def missing():
        go.wait(60)
        raise MissingPackage("no mesher")

    surfacer = Surfacer(done.release, missing)
    go.set()
    surfacer.ask(object(), np.zeros((1, 3)), 0.1)
    assert done.acquire(timeout=60)
    assert surfacer.made is not None and surfacer.made[1:] == (None, "no mesher")
    go.clear()
    surfacer.ask(object(), np.zeros((1, 3)), 0.1)
    surfacer.forget()
    go.set()
    done.acquire(timeout=0.5)  # nobody tells of it where the wish went before the work began
    assert surfacer.made is None
