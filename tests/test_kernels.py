"""What a job needs is compiled before it asks."""

import contextlib
import dataclasses
import importlib
import subprocess
import sys

import numba
import numpy as np
import pytest
from numba import types

from fluidlift import kernels


@pytest.fixture
def remembered(tmp_path, monkeypatch):
    """A place of its own for what is remembered, and a list of two kernels."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    two = kernels.listed()[:2]
    monkeypatch.setattr(kernels, "listed", lambda: two)
    return two


@pytest.mark.parametrize("kernel", kernels.listed(), ids=lambda k: k.function)
def test_what_is_listed_is_a_compiled_function_and_takes_that_many_arguments(kernel):
    module, name = kernel.function.split(":")
    dispatcher = getattr(importlib.import_module(module), name)
    assert len(kernel.types) == dispatcher.py_func.__code__.co_argcount
    assert all(isinstance(kernels.type_of(t), types.Type) for t in kernel.types)


@pytest.mark.parametrize(
    "value",
    [
        1, 1.0, True, None, np.float32(1), np.zeros((2, 3)), np.zeros((2, 3), np.float32)[::2], (1, 2), (1, 2.0),
        (np.zeros(3), (np.zeros(2, np.uint8), 1.0)),
    ],
    ids=repr,
)  # fmt: skip
def test_types_are_read_as_they_are_printed(value):
    kind = numba.typeof(value)
    assert kernels.type_of(str(kind) if isinstance(kind, types.Number | types.NoneType) else repr(kind)) == kind


@pytest.mark.parametrize("text", ["Record", "__import__('os')", "Array(float64, 1, open('x'))", "float64.__class__"])
def test_nothing_but_types_is_read(text):
    with pytest.raises(ValueError, match="not a type of a kernel"):
        kernels.type_of(text)


def test_shares_hold_every_kernel_once_and_take_equally_long():
    listed = kernels.listed()
    shares = kernels._shares(listed, 2)
    assert sorted((k.function, k.types) for s in shares for k in s) == sorted((k.function, k.types) for k in listed)
    seconds = [sum(k.seconds for k in share) for share in shares]
    assert max(seconds) < 1.2 * min(seconds)


def test_what_was_compiled_is_remembered_until_a_source_changes(remembered, monkeypatch):
    assert not kernels.compiled()
    told = []
    kernels.compile_all(2, lambda done, of: told.append((done, of)))
    assert told == [(1, 2), (2, 2)]
    assert kernels.compiled()
    monkeypatch.setattr(kernels, "_sources", list)
    assert not kernels.compiled()


def test_what_cannot_be_compiled_is_not_remembered_and_stops_nothing(remembered, monkeypatch):
    gone = [dataclasses.replace(remembered[0], function="fluidlift.numerics.srgb:gone"), remembered[1]]
    monkeypatch.setattr(kernels, "listed", lambda: gone)
    kernels.compile_all(1)
    assert not kernels.compiled()


def test_a_first_job_says_that_it_compiles_and_leaves_no_process_behind(remembered, monkeypatch):
    started = []

    def worker(listed, output=subprocess.DEVNULL):
        assert [k.function for k in listed] == [k.function for k in remembered[::-1]]  # from the last stage on
        started.append(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]))
        return started[-1]

    monkeypatch.setattr(kernels, "_worker", worker)
    monkeypatch.setattr(kernels, "cores", lambda: 2)  # whatever the machine has, and OMP_NUM_THREADS leaves of it
    said = []
    with contextlib.suppress(RuntimeError), kernels.compiling_beside(said.append):
        raise RuntimeError("the job fails")
    assert said == ["first run of this installation: compiling beside it, once"]
    started[0].wait(60)
    assert not kernels.compiled()
    kernels._remember()
    with kernels.compiling_beside(said.append):
        pass
    assert len(said) == len(started) == 1


def test_where_nothing_can_be_remembered_nothing_is_compiled_beside(remembered, monkeypatch):
    monkeypatch.setattr(kernels, "_writable", lambda place: False)
    assert kernels.compiled()


def test_on_one_processor_nothing_is_compiled_beside(remembered, monkeypatch):
    monkeypatch.setattr(kernels, "_worker", lambda listed: pytest.fail("the job needs the processor"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    with kernels.compiling_beside(pytest.fail):
        assert not kernels.compiled()
