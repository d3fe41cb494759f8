"""How sure means of a record are whose samples hang together: resampling by blocks of it (Künsch 1989).

What is next to each other in time is alike, so a record of n samples says as much as a few independent ones. Blocks
that are longer than that memory are drawn from it in their place. A record around its own mean spreads less than
records among themselves, and blocks of it still hang together: both are made good as for a process of first order with
that memory. A few blocks know their own spread badly: Student's distribution with one degree of freedom less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtrit

from fluidlift.errors import require

MEMORIES = 2.0
"""correlation lengths to a block: of what decays evenly, the mean of a block then lacks a quarter of its variance"""
FEWEST = 3
"""blocks of a record: two know nothing of their spread. A memory that is longer than that allows is not told from a
trend, and Student's distribution with two degrees of freedom is as wide as ignorance of it asks for"""
WINDOW = 5.0
"""correlation lengths over which correlations are added up (Sokal 1997): further away there is noise alone"""
LEVEL = 0.95
"""of the intervals of parameters.json"""

Scale = Literal["logarithm", "logit"]


@dataclass(frozen=True)
class Spread:
    """How far a number may be from what an endless record would give."""

    sigma: float
    """standard deviation, in the variable in which it is taken to be symmetric"""
    freedom: float
    """degrees of freedom of `sigma`: blocks less one"""
    scale: Scale = "logarithm"
    """that variable"""

    def interval(self, value: float, level: float = LEVEL) -> tuple[float, float]:
        """That holds the true number with a probability `level`."""
        reach = min(float(stdtrit(self.freedom, 0.5 + 0.5 * level)) * self.sigma, 700.0)
        if self.scale == "logarithm" or not 0.0 < value < 1.0:
            return value * float(np.exp(-reach)), value * float(np.exp(reach))
        logit = float(np.log(value / (1.0 - value)))
        low, high = (1.0 / (1.0 + np.exp(-np.clip(logit + d, -700.0, 700.0))) for d in (-reach, reach))
        return float(low), float(high)

    def deviation(self, value: float) -> float:
        """`sigma` in the unit of the value, to first order."""
        return self.sigma * (value * (1.0 - value) if self.scale == "logit" and 0.0 < value < 1.0 else abs(value))


@dataclass(frozen=True)
class RecordMemory:
    """How much a record says."""

    count: int
    """samples"""
    block: int
    """of them, that are drawn together"""
    lacks: float
    """times the variance of means of such blocks that a mean of the record has from record to record"""

    @property
    def freedom(self) -> float:
        """Degrees of freedom of what it says of its own spread."""
        return max(self.count / self.block - 1.0, 1.0)


def correlation_length(record: Float[np.ndarray, "n ..."]) -> float:
    """Samples over which a record hangs together: 1 + 2 x the sum of its autocorrelation, of m values their mean; at
    least 1.

    A record's own mean is taken out, so that it seems to forget faster than it does. Of the two lengths that count,
    the longer one is taken: the sum of what is left, and that of a process of first order with the correlation of
    neighbours, freed of that error, (1 + 3 r) / n (Marriott and Pope 1954).
    """
    values = np.asarray(record, np.float64).reshape(len(record), -1)
    n = len(values)
    if n < 2:
        return 1.0
    values = values - values.mean(axis=0)
    power = np.abs(np.fft.rfft(values, 2 * n, axis=0)) ** 2
    together = np.fft.irfft(power.sum(axis=1), 2 * n)[:n]
    if together[0] <= 1e-30:
        return 1.0
    shares, total = together / together[0], 1.0
    for lag in range(1, n):
        # what lies behind the first place that is opposed is the mean's doing
        if shares[lag] <= 0 or lag > WINDOW * total:
            break
        total += 2.0 * float(shares[lag])
    beside = float(shares[1])
    beside = min(beside + (1.0 + 3.0 * beside) / n, 1.0 - 1.0 / n)
    return max(total, (1.0 + beside) / (1.0 - beside), 1.0)


def memory_of(record: Float[np.ndarray, "n ..."]) -> RecordMemory:
    """Of a record: blocks of `MEMORIES` correlation lengths, at most a `FEWEST`-th of it."""
    n, length = len(record), correlation_length(record)
    block = int(np.clip(np.ceil(MEMORIES * length), 1, max(n // FEWEST, 1)))
    # of a process of first order with that memory; without any it is n / (n - block)
    share = (length - 1.0) / (length + 1.0)
    whole, part = _of_mean(share, n), _of_mean(share, block)
    return RecordMemory(n, block, whole * n / (block * (part - whole)) if n > block else 1.0)


def _of_mean(share: float, count: int) -> float:
    """Variance of the mean of so many samples, of which neighbours share that much, over that of one."""
    if share <= 0:
        return 1.0 / count
    decays = 2.0 * share * (1.0 - share**count) / (count * (1.0 - share) ** 2)
    return ((1.0 + share) / (1.0 - share) - decays) / count


def resampled(memory: RecordMemory, draws: int, seed: int) -> Int[np.ndarray, "draws n"]:
    """Numbers of the samples of other records that might have been: blocks of one, which is taken to be a ring."""
    require(memory.count > 0 and draws > 0, f"{memory.count} samples, {draws} times", "some of both")
    rng, each = np.random.default_rng(seed), -(-memory.count // memory.block)
    first = rng.integers(0, memory.count, (draws, each))
    return ((first[..., None] + np.arange(memory.block)) % memory.count).reshape(draws, -1)[:, : memory.count]


def spread_of(drawn: Float[np.ndarray, " draws"], scale: Scale = "logarithm", *memories: RecordMemory) -> Spread:
    """Of a positive number, from what it was in records that were drawn by blocks.

    Args:
        drawn: in each of them.
        scale: the variable in which it is taken to be symmetric.
        memories: of the records that it hangs on; the one that says least counts for all.
    """
    values = np.maximum(np.asarray(drawn, np.float64), 1e-300)
    shown = np.log(values)
    if scale == "logit":
        shown = shown - np.log(np.maximum(1.0 - values, 1e-12))
    lacks = max(m.lacks for m in memories)
    return Spread(float(np.std(shown) * np.sqrt(lacks)), min(m.freedom for m in memories), scale)
