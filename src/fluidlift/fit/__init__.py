"""Physical parameters from measured velocities: windows of frames, rolled out and compared.

Modules of the face:

    coarsen         Halving the resolution of a fit: a rollout costs 16 times less on cells twice as wide with steps
                    twice as long
    optimize        Physical parameters from velocities (paper, `optLoss`): stage 2 as one call
    outcome         What a fit found, judged and in words: whether it may be used, and where each number comes from
    pressure_route  Which way through the pressure a fit takes, from the word of a setting; the paper's is fitted to
                    the flow first
    ranges          Raw optimiser variables to physical parameters and back: the only place where the maps exist
    rising          The buoyancy of smoke: with it, the re-simulation rises as high as the clip's outline
    settings        How a fit is done, as one value
"""

__all__ = [
    "coarsen", "optimize", "outcome", "pressure_route", "ranges", "rising", "settings",
]  # fmt: skip
