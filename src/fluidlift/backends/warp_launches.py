"""Launches of Warp kernels by an iterative solver: whole blocks, graphs of what comes again, numbers for the host."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import warp

BLOCK = 256
"""threads of a block that adds up"""
STARTS = 8
"""graphs kept of what depends on where the arrays of a caller lie"""


class Launches:
    """Launches on one device.

    Args:
        device: where the kernels run.
        graphs: replay what comes again as a CUDA graph; None: on a GPU.
        loops: where there are graphs, they also hold the loop of the iteration: the host waits once per solve. Needs a
            driver for CUDA 12.4 or newer, without which there are no such loops.
        scalars: numbers that steer the iteration, float64 [n], on the device.
    """

    def __init__(self, device: warp.Device, graphs: bool | None, loops: bool, scalars: warp.array) -> None:
        import warp as wp

        self.device = device
        self.count = 0
        """kernels launched so far, those of graphs not counted"""
        self._graphs = device.is_cuda if graphs is None else graphs
        self.loops = loops and self._graphs and (not device.is_cuda or wp.is_conditional_graph_supported())
        """whether `loop` may be used"""
        self._captured: dict[Hashable, Any] = {}
        self._scalars = scalars
        self._host = wp.zeros(len(scalars), dtype=wp.float64, device="cpu", pinned=device.is_cuda)

    def cells(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        """One thread per element."""
        import warp as wp

        self.count += 1
        wp.launch(kernel, dim, inputs, device=self.device)

    def blocks(self, kernel: Any, blocks: int, inputs: list[Any], size: int = BLOCK) -> None:
        """Whole blocks; the kernel's last argument is their size (the CPU has one thread)."""
        import warp as wp

        self.count += 1
        size = size if self.device.is_cuda else 1
        wp.launch_tiled(kernel, dim=[blocks], inputs=[*inputs, size], device=self.device, block_dim=size)

    def run(self, key: Hashable, work: Callable[[], None]) -> None:
        """Do the work; from the second time on that it comes with the same key, by a graph.

        Keys that are tuples depend on the arrays of a caller: only the latest are kept.
        """
        import warp as wp

        if not self._graphs or key not in self._captured:
            starts = [k for k in self._captured if isinstance(k, tuple)]
            if len(starts) >= STARTS:
                self._captured.pop(starts[0])
            self._captured[key] = None
            work()
            return
        if self._captured[key] is None:
            before = self.count
            with wp.ScopedCapture(self.device) as capture:
                work()
            self.count = before
            self._captured[key] = capture.graph
        wp.capture_launch(self._captured[key])

    def loop(self, going: warp.array, body: Callable[[], None], after: Callable[[], None]) -> None:
        """The body while going (int32 [1]) is not 0, then what comes after it, as one graph from the second time on."""
        import warp as wp

        def work() -> None:
            wp.capture_while(going, body)
            after()

        self.run("loop", work)

    def numbers(self) -> np.ndarray:
        """The scalars; waits for the device. The next call writes to the same memory."""
        import warp as wp

        wp.copy(self._host, self._scalars)
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
        return self._host.numpy()
