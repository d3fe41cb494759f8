"""From pictures to velocities: optical flow, its lift into space, and the volume's divergence-free velocity.

Modules of the face:

    align          Subpixel image registration (robust Gauss-Newton) on a reference, by all pixels of the part that
                   stands still
    cadence        Frames that repeat: frame-rate conversion (telecine, GIFs played as video) and stretches where
                   the picture stands
    full_frame     Full-frame stabilisation: what a steadied frame does not see shows another time at which the
                   camera did see it
    lift           Scene flow: optical flow unprojected by depth (paper: V_surf), the one place where px/frame
                   becomes m/s
    moving_camera  A clip of a camera that goes somewhere as from one that stands: each frame drawn again from one
                   place
    optical_flow   Optical flow between neighbouring frames (paper: V_2D): the estimators, and the one door to all
                   of them
    sequence       Velocities of a whole clip, frame by frame (paper: v_gt): flow, mainstream, lift, volume, with a
                   window in memory
    stabilize      Video stabilisation: shake and drift taken out, cuts found
    steady_flow    The measured flow as it would be at a steady frame rate
    thrown_up      How a fountain moves: every drop as a stone does, from its nozzle to its apex and back into the
                   pool
    volume         From the surface to the whole volume (paper: V_vol): extension, bed, and a projection that keeps
                   what was seen
"""

__all__ = [
    "align", "cadence", "full_frame", "lift", "moving_camera", "optical_flow", "sequence", "stabilize", "steady_flow",
    "thrown_up", "volume",
]  # fmt: skip
