"""Graph cut (min-cut) of a picture: log odds per pixel against the length of an outline that shuns smooth places.

Boykov, Jolly 2001 ("Interactive graph cuts"); the maximum flow is scipy's, exact, so the result does not depend on
threads or on order.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, dijkstra, maximum_flow

from fluidlift.errors import require

FIXED_POINT = 50
"""units of capacity per unit of log odds: the flow is in whole numbers"""
LEAST_WEIGHT = 0.1
"""of an edge, as part of the largest: a sharp edge does not make the outline free of cost"""
LARGEST_ODDS = 100.0
"""log odds beyond which a pixel is as good as given"""


def edge_weights(channels: np.ndarray, stiffness: float) -> tuple[np.ndarray, np.ndarray]:
    """Cost of cutting between neighbours, float32 [h,w-1] and [h-1,w], log odds per px.

    A Gaussian of the difference of the channels in units of twice their mean difference over the picture.

    Args:
        channels: float32 [h,w,c].
        stiffness: cost in a smooth place.
    """
    across = np.abs(np.diff(channels, axis=1)).sum(axis=-1)
    down = np.abs(np.diff(channels, axis=0)).sum(axis=-1)
    typical = max(float((across.sum() + down.sum()) / (across.size + down.size)), 1e-6)
    first, second = (
        stiffness * (LEAST_WEIGHT + (1.0 - LEAST_WEIGHT) * np.exp(-((d / (2.0 * typical)) ** 2)))
        for d in (across, down)
    )
    return first.astype(np.float32), second.astype(np.float32)


def neighbours(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the pixels on both ends of every edge of the 4-connected grid: across first, then down."""
    number = np.arange(height * width).reshape(height, width)
    ends = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    return np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()]), ends


def min_cut(odds: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """bool [h,w]: the labelling that minimises minus the odds inside plus the weights of the edges that are cut.

    Args:
        odds: float [h,w], log odds of True.
        across: float [h,w-1], not negative.
        down: float [h-1,w], not negative.
    """
    height, width = odds.shape
    require(across.shape == (height, width - 1) and down.shape == (height - 1, width), "weights of another size")
    pixels = height * width
    source, sink = pixels, pixels + 1
    terminal = np.round(np.clip(odds, -LARGEST_ODDS, LARGEST_ODDS) * FIXED_POINT).astype(np.int32).ravel()
    link = np.round(np.concatenate([across.ravel(), down.ravel()]) * FIXED_POINT).astype(np.int32)
    begin, end = neighbours(height, width)
    fluid, other = np.flatnonzero(terminal > 0), np.flatnonzero(terminal < 0)
    rows = np.concatenate([begin, end, np.full(len(fluid), source), other])
    columns = np.concatenate([end, begin, fluid, np.full(len(other), sink)])
    capacity = np.concatenate([link, link, terminal[fluid], -terminal[other]])
    # SciPy's stubs know `maximum_flow` of the newer csr_array alone
    graph: Any = csr_matrix((capacity, (rows, columns)), shape=(pixels + 2, pixels + 2), dtype=np.int32)
    rest = graph - maximum_flow(graph, source, sink, method="dinic").flow
    rest.data = np.maximum(rest.data, 0)
    rest.eliminate_zeros()
    inside = np.zeros(pixels + 2, bool)
    inside[breadth_first_order(rest, source, return_predecessors=False)] = True
    return inside[:pixels].reshape(height, width)


def geodesic_distance(channels: np.ndarray, seeds: np.ndarray, *, step: float) -> np.ndarray:
    """float64 [h,w]: length of the cheapest way to the seeds, where a step costs the change of the channels.

    Bai, Sapiro 2007.

    Args:
        channels: float32 [h,w,c].
        seeds: bool [h,w], at least one.
        step: cost of a step in a smooth place, in the unit of the channels.
    """
    height, width = seeds.shape
    across = np.linalg.norm(np.diff(channels, axis=1), axis=-1)
    down = np.linalg.norm(np.diff(channels, axis=0), axis=-1)
    begin, end = neighbours(height, width)
    cost = np.concatenate([across.ravel(), down.ravel()]) + step
    graph = csr_matrix((cost, (begin, end)), shape=(height * width, height * width))
    found = dijkstra(graph, directed=False, indices=np.flatnonzero(seeds), min_only=True)
    return found.reshape(height, width)


def disc(radius: float) -> np.ndarray:
    """Round structuring element, u8."""
    size = 2 * max(1, round(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))


def spread(where: np.ndarray, radius: float) -> np.ndarray:
    """bool [h,w]: what lies within so many px (at least 1) of it."""
    return cv2.dilate(where.astype(np.uint8), disc(radius)) > 0
