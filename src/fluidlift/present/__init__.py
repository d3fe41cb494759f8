"""How an asset looks: frames of it as pictures, seamless loops, the card and the report.

Modules of the face:

    as_filmed      The card of an asset: how near its re-simulation stays to its own clip, or why that cannot be
                   told
    frames         The one renderer of frames, for the preview, `fluidlift render` and the viewer's pictures
    front_view     The fluid as the clip's camera sees it: before the clip without its fluid, behind its rocks
    looks          Frames of an asset in another look than its splats' own: relit, transparent, or as the surface of
                   a liquid
    looping        Loops without a visible seam: the frames after the last one fade into the first ones
    report         report.html: what was found, how sure it is, and what to look for in every picture
    surface_waves  Waves on the surface of a frame: as height of its mesh, and as slope of its pictures
    surfacing      The surface of a frame's fluid as a mesh that does not dip into the terrain
"""

__all__ = [
    "as_filmed", "frames", "front_view", "looks", "looping", "report", "surface_waves", "surfacing",
]  # fmt: skip
