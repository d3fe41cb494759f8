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
