"""Physical parameters from measured velocities: windows of frames, rolled out and compared.

Modules of the face:

    coarsen   Halving the resolution of a fit: a rollout costs 16 times less on cells twice as wide with steps twice
              as long
    optimize  Physical parameters from velocities (paper, `optLoss`): stage 2 as one call
    outcome   What a fit found, judged and in words: whether it may be used, and where each number comes from
    ranges    Raw optimiser variables to physical parameters and back: the only place where the maps exist
    rising    The buoyancy of smoke: with it, the re-simulation rises as high as the clip's outline
    settings  How a fit is done, as one value
"""

__all__ = [
    "coarsen", "optimize", "outcome", "ranges", "rising", "settings",
]  # fmt: skip
