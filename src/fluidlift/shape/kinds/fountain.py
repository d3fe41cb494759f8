"""Fountains: a level pool out of which columns rise (`shape.fountain_columns`)."""

from __future__ import annotations

import numpy as np

from fluidlift.shape.kinds.basin import Basin


class _Fountain(Basin):
    def mainstream(self, bulk):
        """Up, as it comes in; most of what is seen of it comes down."""
        return np.array([0.0, 0.0, 1.0])


BUILDER = _Fountain()
