"""Engines of others behind our own seams, chosen by name: flow, masks, depth, generators, renderers, GPU transfers.

Modules of the face:

    colmap_poses       COLMAP's solvers (pycolmap, BSD): poses of a moving camera from tracks of what stands
    depth_model        What a learned model of depth is, and what it says about one picture
    generator_card     What has to be known of a third-party generator before it is used: its terms, what it needs,
                       and where it is from
    generator_licence  The terms of third-party models: shown before the first use, accepted by the user, remembered
                       by their text
    generator_process  A generator in a process of its own, in this or another Python: pictures in, bodies out, and
                       nothing else
    generators         Third-party generators by name: which there are, whether they can run here, and how they are
                       made
    gsplat_rasterizer  gsplat (Apache-2.0) behind the seam of rasterisers: the same pictures on an NVIDIA GPU
    learned            The learned options by name: what `motion.method` and `segment.method` may be besides our own
    mitsuba_renderer   Final frames by Mitsuba 3 (BSD-3-Clause; Jakob et al. 2022): path-traced liquids over terrain
                       and obstacles
    mitsuba_scene      A finished frame as Mitsuba 3 takes it: liquid, solids, light and camera (axes and units:
                       ours, see `types`)
    model_cache        The user's cache of learned models: where they lie, which are there, and whether they are
                       still what was fetched
    model_card         What has to be known of a learned model before its weights are fetched: use, terms, files
                       with their hashes
    model_download     One file from a server or a disk: bounded, hashed as it comes, gone on with where it was cut,
                       no link followed
    model_get          A learned model into the cache, whole and right or not at all: fetched, or brought by hand
    model_table        The learned models that `fluidlift models` knows: one card each, the advised one of each kind
                       first
    monocular_depth    Learned depth by name: what `depth.model` may be
    registry           Registry of the back ends that are chosen by name: one table, by what they are for
    splashsurf         Surfaces of particles by splashsurf: marching cubes on the SPH density, weighted Laplacian
                       smoothing (Loeschner, Boettcher, Jeske and Bender 2023)
    view_model         What a learned model of the view is (which way is up, how wide is the picture), what it says,
                       and which there are
    warp_liquid        The whole substep of a liquid on a Warp device: particles and grid stay there from step to
                       step
    warp_particles     Particle-grid transfers by NVIDIA Warp, on the GPU or (slow, for tests) on the CPU
"""

__all__ = [
    "colmap_poses", "depth_model", "generator_card", "generator_licence", "generator_process", "generators",
    "gsplat_rasterizer", "learned", "mitsuba_renderer", "mitsuba_scene", "model_cache", "model_card",
    "model_download", "model_get", "model_table", "monocular_depth", "registry",
    "splashsurf", "view_model", "warp_liquid", "warp_particles",
]  # fmt: skip
