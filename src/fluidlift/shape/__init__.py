"""From a clip and its masks to a body: what kind of fluid, where up is, how large, what lies below, which Gaussians.

Modules of the face:

    airborne          The place of a body that moves through the air: a jet above its pool, a plume above a floor
    background        Background subtraction: the still scene behind a fluid that moves through the picture; what
                      stands out from it
    composite         A body of two parts in the geometry: what lies, and the jets that fall onto it
    dam               A body of liquid that is let go: when, and what the masks of the clip say of its shape and of
                      its basin
    depth_surface     A fluid's visible surface from a depth picture: what the picture can say is taken from it, the
                      rest from physics
    drawn             What a person drew on a frame, as pixels, and carried to the other frames
    drawn_flow        The direction of the flow as a person drew it: arrows, each of which counts as given around it
    evidence          Motion segmentation cues for fluid: change against the clip's own noise, and motion that goes
                      somewhere
    external_body     A body from elsewhere: Gaussians that another generator made, seen by a known camera
    fill              Fills a hollow body with Gaussians by the parity of random rays (paper: filling before the
                      simulation)
    filled_vessel     The vessel that a pour fills: a solid of revolution about a vertical axis, from the silhouette
                      of what it holds
    fluid_found       How much of the pictures was taken for fluid, and how sure labels and flow are there
    frame_pictures    Small steady pictures of a clip of any length: a bounded sample kept, the other frames made
                      when asked for
    framing           Where the fluid lies in the picture and in time: what a mask can say against itself before a
                      body is made of it
    generate          The embedded generator: from a picture, a mask and a model of the front surface to Gaussians,
                      without any weights
    given_depth       Depth that comes from elsewhere, a file or a learned model: one picture of several frames,
                      made comparable
    ground            What a fluid rests in: cells and terrain from its surface, and the ground's texture or colours
    ground_texture    The ground's texture: the picture laid on a terrain as a map seen from above, as fine as the
                      picture itself
    hints             What the user says about a mask: points that are fluid or are not, a rectangle
    jet_column        A jet in space: a round column that stands vertically on the surface of the fluid below it
    kind              What kind of fluid a clip shows, and where up is: decided from evidence that the report can
                      show
    kinds             How the body of each kind of fluid is built: one file per kind, found by its name
    looked_into       What a rim says of a vessel that is looked into: where it stands, how wide it is, and how high
                      the liquid in it is
    occluders         What stands before a fall and hides it (a plant, a post, a parapet), told from ground by what
                      the water does there
    off_picture       Extrapolation of a stream's surface beyond the edges of the picture: the seen one goes on as
                      in a mirror
    prune             Denoises a body: takes out faint, stretched, huge, lonely and broken Gaussians (paper: before
                      the filling)
    puddle            Puddles that jets fall into, seen from above: told from a vessel seen from the side
    refine            Refines Gaussians on one frame, so that they carry every pixel of it, without bending the body
                      (paper: `loss_optGS`)
    registration      Registration and scale, from the canonical frame of a single view to metres: the free scale,
                      heading, origin
    rest_frames       Which frames of a clip become the body at rest
    seen_bed          Whether the bed is seen through the water, where, and what it looks like: the still layer of a
                      moving picture
    segment           Which pixels of a clip are fluid, without learned weights
    slope             How steep a stream or a film runs, and how the camera is tilted over it, from the perspective
                      of its motion
    standing          A body of liquid that stands on level ground and is let go (a dam break), and the basin that
                      it spreads in
    surface           Where the visible surface of a fluid is: level planes, falling profiles, inflated silhouettes,
                      given depths
    texture_gradient  What the fluid's own pattern (foam, ripples) says about the plane it lies on: shape from
                      texture
    texture_grain     Grain of a texture where it was not seen: random pieces of the seen one, blended so that they
                      stay as lively
    thrown            Water that is thrown up: whether a body in the picture both rises and falls, and stands free
                      of its background
    unite             Makes the bodies of several frames one (paper: union over N frames), and says how many frames
                      that should be
    view              Which way is up: what a picture says of it beside the fluid's motion, as log likelihoods of
                      the camera's tilt
    warm_start        Warm start of the frames after the first: each is refined from the Gaussians of the frame
                      before it
"""

__all__ = [
    "airborne",
    "background",
    "composite",
    "dam",
    "depth_surface",
    "drawn",
    "drawn_flow",
    "evidence",
    "external_body",
    "fill",
    "filled_vessel",
    "fluid_found",
    "frame_pictures",
    "framing",
    "generate",
    "given_depth",
    "ground",
    "ground_texture",
    "hints",
    "jet_column",
    "kind",
    "kinds",
    "looked_into",
    "occluders",
    "off_picture",
    "prune",
    "puddle",
    "refine",
    "registration",
    "rest_frames",
    "seen_bed",
    "segment",
    "slope",
    "standing",
    "surface",
    "texture_gradient",
    "texture_grain",
    "thrown",
    "unite",
    "view",
    "warm_start",
]  # fmt: skip
