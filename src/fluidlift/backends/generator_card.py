"""What has to be known of a third-party generator before it is used: its terms, what it needs, and where it is from."""

from __future__ import annotations

from dataclasses import dataclass

from fluidlift.errors import require


@dataclass(frozen=True)
class GeneratorCard:
    """Facts about one generator. None of them needs its packages: they are shown where it is not installed."""

    name: str
    """as the command line has it: lower case with hyphens, such as triplane-gaussian"""
    title: str
    """as its authors call it, with the year"""
    licence: str
    """one paragraph: the licence of the code, that of the weights, and what of it comes from others"""
    licence_commercial: bool
    """whether code and weights may both be used commercially"""
    home: str
    """address of the project"""
    packages: tuple[str, ...]
    """what it imports, as Python names such as "tgs" or "diff_gaussian_rasterization", the generator's own first"""
    hardware: str
    """what it was made for, and what it does without that"""
    weights: tuple[str, ...]
    """names on the hub, with the file where it is one, such as "VAST-AI/TriplaneGaussian/model_lvis_rel.ckpt" """
    notes: tuple[str, ...] = ()
    """what else a user should know: what it is good and bad at for fluids, known faults that are worked around"""
    install: tuple[str, ...] = ()
    """shell commands that make an environment for it, in order"""
    needs_gpu: bool = True
    """whether it cannot run on a CPU at all"""
    environment: tuple[tuple[str, str], ...] = ()
    """environment variables that it needs, as (name, value)"""
    metric: bool = False
    """whether its bodies are in metres, given the true field of view"""

    def __post_init__(self) -> None:
        known = self.name.replace("-", "").isalnum() and self.name == self.name.lower()
        require(known, f"generator name {self.name!r}", "lower case, digits and hyphens")
        require(bool(self.licence.strip()), f"no licence on the card of {self.name}", "its terms, in words")
        require(bool(self.packages), f"no packages on the card of {self.name}", "the names that it imports")
