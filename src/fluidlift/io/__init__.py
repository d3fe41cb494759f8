"""Files of every kind, to and from values. What comes from strangers is bounded before it is taken.

Modules of the face:

    array_archive  Arrays of .npy and .npz files that may come from anyone: no pickles, and nothing is taken on a
                   header's word alone
    asset_folder   The asset folder: what is written where, and a reader that trusts nothing
    asset_lock     Who is at work on an asset: one process at a time writes its frames, one edit at a time changes
                   its scene.yaml
    asset_paths    Paths below an asset, none of which leads out of it: asset folders come from strangers, and they
                   hold no links
    atomic         Files that are either whole or absent, and disk errors that say what to do
    bars           Letterbox and pillarbox: flat black bars that editing put beside a picture, and the picture
                   between them
    checkpoint     Checkpoints: the state of a simulation between two frames, from which it goes on bit for bit
    collect        Decoded frames become a clip: which are kept, how large, and where they lie meanwhile
    decode         Video files through PyAV, with the doors shut: no playlists, no networks, no frames beyond the
                   limits
    entries        What a person wrote into a YAML file, taken entry by entry; a complaint names the line and the
                   nearest valid name
    environments   Panoramas of light, as artists download them: Radiance .hdr and OpenEXR, equirectangular, 2:1,
                   linear
    export_gltf    glTF binary: one instant of a fluid with its ground and its camera
    export_mesh    Meshes for other tools: glTF binary (y up), PLY and OBJ (z up)
    export_page    One HTML file that plays an asset offline: frames, terrain, script and poster inside, nothing is
                   fetched
    export_usd     OpenUSD: a layer that a person opens and edits (fluid.usda) over the heavy payload (fluid.usdc)
    exr_write      OpenEXR pictures, written with NumPy: float32 channels of any name, scan lines, ZIP compression
    flow_files     Optical flow from and for other tools: Middlebury .flo, OpenEXR motion vectors, .npz, .npy and
                   KITTI's 16-bit PNG
    footage_file   A small film of the fluid that an asset carries: what its surface looks like over time, for
                   simulations without the clip
    force_file     What an asset carries of the filmed flow: the steady body force that keeps it, the cells where it
                   never is and where it always is, and its motion frame by frame, where that was asked for
    frame_checks   Is a frame of particles sound, and does it continue the one before? Words, not exceptions
    frames         One instant of an animated fluid, as the exporters take it
    hashes         SHA-256 of files: whether they are still what was written
    hints_file     hints.yaml: what a person says of a clip, read from strangers and written for people
                   (docs/hints.md)
    images         What a user may bring besides the clip: masks, depth and cameras
    kept_values    Values of stages that are kept in an asset's folder work/, read back without knowing how to make
                   them
    lens           The lens that a video's metadata names
    limits         How much a reader takes in before it says no, and the first look at any file that a user names
    obstacles      Obstacles of scene.yaml: what a person puts into the fluid, as read and checked, before physics
                   takes it over
    output_files   What a command that writes files for other tools tells at its end
    packed_splats  Frames of a simulation, packed: a sixth of the size of a PLY, with a bound on what is lost of
                   each number
    page_frames    Frames of splats as a page on the web plays them: 16 bytes per splat, and of those only what
                   changes
    pictures       One still picture, read with care, and resampling
    ply            PLY: Gaussians as 3D Gaussian splatting tools exchange them, points, and meshes
    read_mesh      Triangle meshes from files of strangers: OBJ, PLY and binary glTF
    scene          scene.yaml: the one file of an asset that a person edits
    scene_domain   Whether what a person put into a scene lies where the simulation takes place
    scene_look     The section `look` of scene.yaml: how frames are drawn
    scene_path     Places in a scene by their names, as a person writes them: `parameters.gravity`,
                   `obstacles.duck.position`
    scene_text     Changes of scene.yaml's text that leave the rest as a person wrote it: comments, order, spacing
    sequences      Numbered pictures as a clip: `frames/%04d.png`, `frames/####.png`, or a folder of pictures
    spz            SPZ: one frame of Gaussians in a tenth of the size of a PLY, as viewers on the web and on phones
                   take them
    stage_cache    Results of stages under work/<stage>/<key>.npz and .json, so that a killed or repeated run
                   resumes
    stage_codec    Values as arrays and JSON: frozen dataclasses are packed and unpacked by the types of their
                   fields
    validate_usd   Is a USD file sound? The validators of OpenUSD, and what they do not look at: the arrays of
                   splats at every time
    video          Clips in and previews out
    views          Camera paths that a person writes: keyed views in a JSON file
    volume_grid    OpenVDB files written with NumPy: float and vector grids of cubic voxels, ZIP-compressed, active
                   voxels only
    yaml_reader    YAML from strangers: scene.yaml, settings, lists of shots and values on the command line are all
                   read here
"""

__all__ = [
    "array_archive",
    "asset_folder",
    "asset_lock",
    "asset_paths",
    "atomic",
    "bars",
    "checkpoint",
    "collect",
    "decode",
    "entries",
    "environments",
    "export_gltf",
    "export_mesh",
    "export_page",
    "export_usd",
    "exr_write",
    "flow_files",
    "footage_file",
    "force_file",
    "frame_checks",
    "frames",
    "hashes",
    "hints_file",
    "images",
    "kept_values",
    "lens",
    "limits",
    "obstacles",
    "output_files",
    "packed_splats",
    "page_frames",
    "pictures",
    "ply",
    "read_mesh",
    "scene",
    "scene_domain",
    "scene_look",
    "scene_path",
    "scene_text",
    "sequences",
    "spz",
    "stage_cache",
    "stage_codec",
    "validate_usd",
    "video",
    "views",
    "volume_grid",
    "yaml_reader",
]  # fmt: skip
