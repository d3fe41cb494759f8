"""Scenes whose truth is known: made by our own simulators or by formulas, filmed by our own camera.

Modules of the face:

    analytic        Velocity fields that are known in closed form, sampled on the faces of a MAC grid
    demo            The clip that comes with the package, and its truth
    fountain        Small clips of water in the air over a pool, by a formula: fountains, and falls and spouts that
                    are none
    moving_texture  Small clips with exactly known motion: a procedural texture carried along a flow that a formula
                    gives
    record          Runs a synthetic scene and writes its case folder: the clip, the camera, and the exact truth
    riverside       A river between banks, boulders and trees, filmed by a camera on a known path: truth for cameras
                    that go somewhere
    scenes          Small scenes whose truth is known because this project simulates them itself: a stream, a pour,
                    honey, a dam
    tanks           Standard scenes of free-surface flow, ready for the liquid simulator: the set-ups that
                    experiments and theory know
    twins           Twin experiments: flows that the rollout itself made with known parameters, to be found again
                    from a wrong start
"""

__all__ = [
    "analytic", "demo", "fountain", "moving_texture", "record", "riverside", "scenes", "tanks", "twins",
]  # fmt: skip
