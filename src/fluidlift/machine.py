"""What the machine has left, and how its threads are shared."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    usage = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return usage / (1024.0 * 1024.0 if sys.platform == "darwin" else 1024.0)


def available_memory() -> int:
    """Bytes that this process can still take without swapping: what the machine or its container has left."""
    free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError, IndexError, StopIteration):  # Linux: free memory and what files are cached in
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    with suppress(OSError, ValueError, StopIteration):  # a container; "max" is no number
        group = Path("/sys/fs/cgroup")
        taken = int((group / "memory.current").read_text())
        stat = (group / "memory.stat").read_text().splitlines()
        cached = next(int(line.split()[1]) for line in stat if line.startswith("inactive_file "))
        free = min(free, max(int((group / "memory.max").read_text()) - taken + cached, 0))
    return free


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch's and Numba's thread pools spin against each other: loops that alternate both are faster on one thread."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


THREADS = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM",
)  # fmt: skip
"""environment variables by which torch, NumPy, Numba and OpenCV are told how many threads they may start"""


def cores() -> int:
    """Processors that this process may use: those of its CPU set, or fewer where `OMP_NUM_THREADS` says so."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(ValueError):
        found = min(found, int(os.environ.get("OMP_NUM_THREADS", "")))
    return max(found, 1)


def group_memory(group: int) -> int:
    """Resident bytes of all processes of a process group; 0 where the system does not tell (no /proc)."""
    pages = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):  # gone meanwhile
            if int((process / "stat").read_text().rpartition(")")[2].split()[2]) == group:
                pages += int((process / "statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
