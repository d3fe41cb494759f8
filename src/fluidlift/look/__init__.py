"""How a fluid looks: splats and surfaces drawn, light, textures, the picture of what was filmed.

Modules of the face:

    apparent_shift      Where overlapping splats of a surface appear: the nearer ones hide the near side of those
                        behind them
    appearance          What of a fluid's look stays in place and what moves with it
    camera_path         Where a film is seen from: one camera for every frame
    clear_water         Water that one sees through: where its bent rays meet the bed, the bed's own colours, and
                        what the water absorbs
    display             Tone mapping: from linear light to what a display shows
    environment         The light around a scene: a picture of all directions, and what surfaces of any roughness
                        see of it
    environment_lookup  Directions and equirectangular pictures: where a direction lies, and the picture's value
                        there
    filmed_outline      The waterline of a film on the surface of its simulation, finer than the simulator's cells
    fluid_normals       Normals of a fluid's surface at its splats, from the density of the splats themselves
    footage             Video texture: what a fluid looks like in each place over time, from its film; what stays,
                        what comes and goes
    ground_picture      Ground and obstacles in a picture, in the light of an environment, with the shadows that
                        they and the liquid cast
    inflow              Appearance of fluid that flows in: the body downstream, mirrored, with all of its splats
    liquid              A liquid's surface as a camera sees it, and the light that it sends there
    materials           What a liquid is made of, for pictures: refractive index, absorption, scattering, glow
    mixing              The look of fluid that was drawn out further than its splats can show
    optics              Light at the surface of a transparent body and inside it: Fresnel, Snell, Beer and Lambert
                        (Born and Wolf 1999), and the colour of a deep body that scatters (van de Hulst 1980) and
                        what a layer of it lets through (Kubelka, Munk 1931)
    outlet_section      The open ends of a stream: where what is simulated ends, a picture shows a clean section
    picture_texture     What a fluid that falls or stands looks like in its film, by place in the picture
    pictures            Fields and curves as pictures for the report
    project             What makes any Gaussians drawable from one camera: colours for the view, nothing broken,
                        nothing huge
    rasterize           Gaussian splatting: Gaussians to a picture, expected depth and coverage (alpha compositing),
                        on the CPU
    relight             Relighting of splats: image-based light, split sum; after GaussianShader (Jiang et al. 2024,
                        arXiv:2311.17977)
    report              The report: one HTML file with everything in it
    scenery             Terrain in pictures: as surfels beside the fluid's splats, and as a depth that hides what
                        lies behind rocks
    screen_space        The surface of a liquid in a picture: of particles, drawn as spheres and smoothed in the
                        picture, or of a mesh
    seen_texture        What the surface of a body at rest looks like to the camera that saw it, by place in plan
    smoke_film          How opaque smoke is in each place of a film, and its own color there: matting before a known
                        background
    smoke_splats        Smoke as splats: how wide and how opaque they are for all of them together to be as thin as
                        what was filmed
    smoothstep          From 0 to 1 with level ends (smoothstep), for arrays and for compiled loops
    solid_contact       A liquid's surface carried on to the solid that it meets
    stream_slab         A piece of a stream as a slab that one can pick up, and how it goes on beyond its ends
    surface_axes        The axes over which the surface of a liquid is a map: the plan for what lies, the picture
                        for what falls or stands
    surface_foam        White water on the surface of a clear liquid: what its splats show brighter than it could
                        mirror
    surface_map         The free surface of a liquid that lies, as a map over the plan: where it is, how high it
                        stands, how it moves
    surface_skin        Surface appearance: a skin of small splats over the free surface of a liquid
    surface_windows     Squares of a filmed surface, resampled to metres over the plan: what its spectrum is taken
                        from
    texture_patches     Advected textures (Lagrangian patches): the fine look of a liquid's surface, on patches that
                        are not drawn out
    transparent         The surface of a liquid straight from its splats, without a mesh
    vessel              What a pour falls into, as thin glass: which faces of the ground are the vessel, and what
                        its walls do to a picture
    wave_relief         Waves played on the surface of a simulated liquid: its small-scale relief, as height and
                        slope at any place and time
    wave_spectrum       Waves that a film of a surface shows: its brightness by wavenumber and frequency, and slopes
                        from brightness
    wet_ground          Ground that liquid stands on, in the picture behind that liquid: wet ground is darker than
                        dry ground
    whitewater_splats   What white water looks like: small splats in the clip's foam colour, and where a clip shows
                        foam at all
"""

__all__ = [
    "apparent_shift", "appearance",
    "camera_path",
    "clear_water",
    "display",
    "environment",
    "environment_lookup",
    "filmed_outline",
    "fluid_normals",
    "footage",
    "ground_picture",
    "inflow",
    "liquid",
    "materials",
    "mixing",
    "optics",
    "outlet_section",
    "picture_texture",
    "pictures",
    "project",
    "rasterize",
    "relight",
    "report",
    "scenery",
    "screen_space",
    "seen_texture",
    "smoke_film",
    "smoke_splats",
    "smoothstep",
    "solid_contact",
    "stream_slab",
    "surface_axes",
    "surface_foam",
    "surface_map",
    "surface_skin",
    "surface_windows",
    "texture_patches",
    "transparent",
    "vessel",
    "wave_relief",
    "wave_spectrum",
    "wet_ground",
    "whitewater_splats",
]  # fmt: skip
