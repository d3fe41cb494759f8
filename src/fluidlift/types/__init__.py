"""Floor 0: frozen values that check themselves.

Modules of the face:

    camera           The pinhole camera: OpenCV axes (x right, y down, z forward), pixel centres at +0.5, no
                     distortion
    clip             Pictures in time and what each pixel shows
    flow             Motion seen in pictures and motion in the world
    fluid_masks      The fluid of a clip, frame by frame, without holding all of it
    gaussians        3D Gaussians, activated: linear scales in metres, opacity in [0, 1]
    grid             The staggered (MAC) grid: index order x, y, z; velocity components live on cell faces
    harmonics        Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting (Kerbl
                     et al. 2023)
    hints            What a person says of a clip, in px and seconds of that clip: so it holds at any working size
                     and for any trim
    kind             Kinds of fluid: what each one is, and what is usual for it
    parameter_table  Table of the physical parameters: what scene.yaml, the fit and the viewer know of each, in one
                     place
    quantity         Quantities as people write them, "3 s", "10 cm", "2 cSt", in SI units
    rows             Some rows of an array of vectors: NumPy gathers short rows one number at a time, and `take` a
                     row at a time
    stages           What the stages leave: one frozen value per stage, which checks itself
    terrain          The solid world that a fluid runs over
    transforms       Rigid motions, similarities and quaternions
"""

from fluidlift.types.asset import FORMAT_VERSION, FluidAsset
from fluidlift.types.camera import PinholeCamera, ViewKey
from fluidlift.types.camera_path import CameraPath, MeasuredView
from fluidlift.types.clip import Label, PixelLabels, VideoClip
from fluidlift.types.evidence import BedEvidence, KindEvidence, MetricScale, SlopeEvidence, UpEvidence
from fluidlift.types.filmed import Filmed, FilmedMotion
from fluidlift.types.flow import PixelFlow, SaidFlow, SurfaceMotion
from fluidlift.types.gaussians import SH_C0, Gaussians, concatenate, decompose_covariances, sh_from_rgb
from fluidlift.types.grid import CellType, FaceVelocity, Grid, triple
from fluidlift.types.kind import KINDS, FluidKind, kind_of
from fluidlift.types.parameters import GRAVITY, Estimate, FluidParameters
from fluidlift.types.particles import Particles
from fluidlift.types.results import FitResult, SolveReport
from fluidlift.types.terrain import Coat, Setting, Terrain, TriangleMesh, VesselRim
from fluidlift.types.transforms import RigidTransform, Similarity3, matrix_from_quat, quat_from_matrix

__all__ = [
    "FORMAT_VERSION",
    "GRAVITY",
    "KINDS",
    "SH_C0",
    "BedEvidence",
    "CameraPath",
    "CellType",
    "Coat",
    "Estimate",
    "FaceVelocity",
    "Filmed",
    "FilmedMotion",
    "FitResult",
    "FluidAsset",
    "FluidKind",
    "FluidParameters",
    "Gaussians",
    "Grid",
    "KindEvidence",
    "Label",
    "MeasuredView",
    "MetricScale",
    "Particles",
    "PinholeCamera",
    "PixelFlow",
    "PixelLabels",
    "RigidTransform",
    "SaidFlow",
    "Setting",
    "Similarity3",
    "SlopeEvidence",
    "SolveReport",
    "SurfaceMotion",
    "Terrain",
    "TriangleMesh",
    "UpEvidence",
    "VesselRim",
    "VideoClip",
    "ViewKey",
    "camera",
    "clip",
    "concatenate",
    "decompose_covariances",
    "flow",
    "fluid_masks",
    "gaussians",
    "grid",
    "harmonics",
    "hints",
    "kind",
    "kind_of",
    "matrix_from_quat",
    "parameter_table",
    "quantity",
    "quat_from_matrix",
    "rows",
    "sh_from_rgb",
    "stages",
    "terrain",
    "transforms",
    "triple",
]  # fmt: skip
