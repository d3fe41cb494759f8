"""Floor 0: frozen values that check themselves."""

from fluidlift.types.asset import FORMAT_VERSION, FluidAsset
from fluidlift.types.camera import PinholeCamera, ViewKey
from fluidlift.types.clip import Label, PixelLabels, VideoClip
from fluidlift.types.evidence import KindEvidence, MetricScale, SlopeEvidence, UpEvidence
from fluidlift.types.filmed import Filmed
from fluidlift.types.flow import PixelFlow, SurfaceMotion
from fluidlift.types.gaussians import SH_C0, Gaussians, concatenate, decompose_covariances, sh_from_rgb
from fluidlift.types.grid import CellType, FaceVelocity, Grid, triple
from fluidlift.types.kind import KINDS, FluidKind, kind_of
from fluidlift.types.parameters import Estimate, FluidParameters
from fluidlift.types.particles import Particles
from fluidlift.types.results import FitResult, SolveReport
from fluidlift.types.terrain import Setting, Terrain, TriangleMesh
from fluidlift.types.transforms import RigidTransform, Similarity3, matrix_from_quat, quat_from_matrix

__all__ = [
    "FORMAT_VERSION", "KINDS", "SH_C0", "CellType", "Estimate", "FaceVelocity", "Filmed", "FitResult", "FluidAsset",
    "FluidKind", "FluidParameters", "Gaussians", "Grid", "KindEvidence", "Label", "MetricScale", "Particles",
    "PinholeCamera", "PixelFlow", "PixelLabels", "RigidTransform", "Setting", "Similarity3", "SlopeEvidence",
    "SolveReport", "SurfaceMotion", "Terrain", "TriangleMesh", "UpEvidence", "VideoClip", "ViewKey", "concatenate",
    "decompose_covariances", "kind_of", "matrix_from_quat", "quat_from_matrix", "sh_from_rgb", "triple",
]  # fmt: skip
