"""Methods that know nothing of fluids: solvers, interpolation, distances, splatting.

Modules of the face:

    block_bootstrap         How sure means of a record are whose samples hang together: resampling by blocks of it
                            (Künsch 1989)
    bspline                 The quadratic B-spline of particle-grid transfers
    cell_list               Points sorted into cubes of space, so that what is near a place is found in 27 of them
                            (cell list, Numba)
    ground_block            The ground as a block that one can pick up: a surface over its box, closed at the sides
                            and below
    harmonics               Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting
                            (Kerbl et al. 2023)
    homography2             Homographies of the picture plane as matrices [3,3] that act on pixel indices (as
                            cv2.warpPerspective takes them)
    isosurface              Triangles of a level set: naive surface nets (Gibson 1998), vectorised
    lanes                   Four or eight single-precision numbers at once, for Numba kernels
    mesh_distance           Signed distance of a closed triangle mesh on a grid of its own frame
    mesh_normals            Normals of triangle meshes
    mirror                  Points continued beyond their ends by their own mirror image: what lies there, and moves
                            in from there
    multigrid               Conjugate gradients preconditioned by a geometric multigrid V-cycle, for the cell
                            Poisson equation
    multigrid_assembly      Levels of the multigrid solver: the operator on the finest grid and on coarser ones
                            (memory: `multigrid_kernels`)
    multigrid_cycle         The V-cycle and the conjugate gradients of the multigrid solver (memory:
                            `multigrid_kernels`)
    nearest                 Nearest neighbours: in a k-d tree, or, where points lie about evenly, in the cells
                            around a place
    outline                 Where an outline ends
    over_time               Orders and medians over the pictures of a film, place by place: what NumPy does one
                            place at a time
    particle_mean           What particles carry, at other points: means weighted by a kernel (Numba)
    poisson                 The Poisson equation on irregular cell domains (Dirichlet and Neumann): system, plain
                            solvers, the fast one
    recurrent_stencil       The Poisson iteration as a recurrent convolution with fitted kernels (paper: PeRCNN;
                            Rao, Sun, Liu 2021)
    recurrent_stencil_fit   Fitting the recurrent stencil to solved pressure problems, and judging it before use
                            (paper: `percnn_str_fit`)
    sampling                Trilinear interpolation of grid fields at points
    sharing                 How the work of a loop is shared out among threads
    short_axis              Sums, lengths and extremes over a last axis of two or three, and boxes around points:
                            colours and vectors
    signed_distance         Signed distance fields (SDF) at grid nodes: making them, and keeping points outside the
                            solid
    similarity2             Similarities of the picture plane as matrices [2,3] that act on pixel indices (as
                            cv2.warpAffine takes them)
    solid_mesh              Closed triangle meshes as solids: checks, exact integrals, simple shapes, points on the
                            surface
    splatting               Gaussian splatting on the CPU: projection, binning, front-to-back compositing and the
                            exact derivatives of all
    splatting_colors        Colours of Gaussians as a camera sees them: real spherical harmonics up to degree 3,
                            with their exact derivatives
    splatting_colors_torch  Differentiable colours of Gaussians in torch: the kernels of `splatting_colors` as an
                            autograd function, and plain
    splatting_kernels       The compiled loops over pixels of `splatting` (Numba), with their constants
    splatting_projection    The compiled loops that take Gaussians into the picture and their gradients back (Numba)
    splatting_torch         Differentiable Gaussian splatting in torch: the fast kernels of `splatting` as autograd
                            functions, and a plain twin
    srgb                    The sRGB curve (IEC 61966-2-1) between linear light and what pictures store
    symmetric3              Axes of many symmetric 3x3 matrices at a time, for Numba kernels: cyclic Jacobi in lanes
    textures                Pictures on surfaces
    torch_multigrid         The Poisson equation on irregular domains on any torch device: multigrid-preconditioned
                            conjugate gradients
    torch_poisson           The Poisson system of `poisson` and its coarser levels as tensors on one device (solver:
                            `torch_multigrid`)
    triangles               Triangle rasterisation (z-buffer): the face that each pixel sees, where and how far; and
                            how deep closed bodies are
"""

__all__ = [
    "block_bootstrap", "bspline", "cell_list", "ground_block", "harmonics", "homography2", "isosurface", "lanes",
    "mesh_distance", "mesh_normals", "mirror", "multigrid", "multigrid_assembly", "multigrid_cycle", "nearest",
    "outline", "over_time", "particle_mean", "poisson", "recurrent_stencil", "recurrent_stencil_fit", "sampling",
    "sharing", "short_axis", "signed_distance", "similarity2", "solid_mesh", "splatting", "splatting_colors",
    "splatting_colors_torch", "splatting_kernels", "splatting_projection", "splatting_torch", "srgb", "symmetric3",
    "textures", "torch_multigrid", "torch_poisson", "triangles",
]  # fmt: skip
