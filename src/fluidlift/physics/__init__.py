"""The terms of the equations of motion, and the simulators and the differentiable rollout made of them.

Modules of the face:

    active_region         The active region of the grid, which a substep works on: cost follows the liquid, not the
                          box
    advection             Semi-Lagrangian advection of face velocities, differentiable (Stam 1999; paper, "Grid-
                          Based Velocity Evolution")
    apic                  The liquid simulator: affine particle-in-cell (APIC) and pressure projection (paper:
                          "Presumed APIC Simulation")
    boundaries            Boundary conditions: walls (cut cells; free slip to no-slip), liquid cells, extrapolation,
                          particle collisions
    channel_extension     Extrapolation of the channel: the terrain goes on downstream of the outlet as it is there
    deform                Deformation of particles and of the Gaussians they carry (paper: F <- (I + dt C) F, A = F
                          A0 F^T)
    device_liquid         What a liquid needs that is simulated where its particles are, such as on a GPU, and what
                          cannot be done there
    emitter               Emitters: closed meshes in the world whose volume is kept full of fluid while they are on
    free_surface          Reconstruction of the free surface (a level set) from particles, to a few hundredths of a
                          cell
    gas                   The gas simulator: smoke in air on a MAC grid, with MacCormack advection; tracers move by
                          RK2
    guidance              Nudging and other body forces that depend on place: a pull towards a known flow, a steady
                          one that keeps it, and one that goes through a film
    inflow_schedule       The inflow over time: a factor on the inflow's velocity, between keyframes, with a surge
                          of its own; and where the inlet stands, as that of a jug in a hand
    inlet                 The inlet: Dirichlet velocity in INFLOW cells (paper: v_in, v~_in) and gap-free emission
                          of particles
    liquid_grid           The grid half of a liquid's substep: from particles to the new velocity on all faces near
                          the liquid
    numba_particles       The particle half of a step on the CPU: what `seams.ParticleTransfer` and
                          `seams.ParticleMover` ask for, in Numba
    outlet                The free outlet (Dirichlet pressure): p = 0 at its rim, hydrostatic in columns of liquid
                          that stand on the ground
    position_correction   Position correction against clumps: particles are spread from crowded places, their
                          velocity left alone
    preflight             What would fail during a simulation, said before it begins, with the numbers
    pressure              Pressure projection to a divergence-free face velocity, with cut cells (paper: `eq::v`,
                          first term; `divProj`)
    refill                Cells that are kept from running dry, since fluid is known to be in them at all times
    reseed                Particle reseeding by splitting and merging: inner cells get neither empty of particles
                          nor stuffed with them
    rigid                 Rigid bodies in the liquid: their state, and what a substep of the simulator asks of them
    rigid_body            Rigid bodies as they are given: shape, material, motion
    rollout               DiffSim^n: n differentiable steps of incompressible flow on a MAC grid (paper, "Presumed
                          APIC Simulation")
    rollout_domain        The cell layout of a differentiable rollout: which face does what, assembled once
    rollout_pressure      The pressure of a rollout: the ways through the Poisson equation and their gradients,
                          behind one door (`project`)
    rollout_surface       The free surface (a level set) of a rollout's liquid, between the cells of its layout, for
                          ghost-fluid pressure
    rollout_torch         DiffSim^n in plain torch operations on any device: the readable twin of `rollout`, and its
                          way onto a GPU
    rollout_torch_domain  The layout of a rollout as tensors on any device, and its linear operators as whole-array
                          slices
    rotation              Rotations of rigid bodies: quaternions (w, x, y, z) and their motion
    stepping              What the liquid and the gas simulator share: time stepping, particles, inlet and outlet
    surface_kernels       The kernels behind `physics.free_surface`, in cells; their plain twins are there
    surface_tension       Surface tension (Young-Laplace, ghost fluid): the pressure jumps by sigma times the sum of
                          the principal curvatures
    surroundings          What a fluid moves in: its box, walls and inlet, the numerical choices, and what viscosity
                          does between them
    terrain_edit          Edits of the terrain before a simulation: moved, turned, scaled, twisted or replaced
    terrain_reshape       What edits of the terrain make of it: solid, cells, water and its Gaussians in their new
                          places
    transfer              P2G and G2P: affine particle-in-cell (APIC) transfers on the MAC grid (paper:
                          `particle_map`; Jiang et al. 2015)
    viscosity             Implicit viscosity (backward Euler), components coupled by the full stress (paper:
                          `eq::v`, second term)
    wave_dispersion       Linear waves on a liquid's free surface: how frequency and wavenumber belong together
                          (gravity and capillarity)
    whitewater            White water: spray, foam and bubbles as particles that a liquid makes and carries, and
                          that do not act on it
"""

__all__ = [
    "active_region",
    "advection",
    "apic",
    "boundaries",
    "channel_extension",
    "deform",
    "device_liquid",
    "emitter",
    "free_surface",
    "gas",
    "guidance",
    "inflow_schedule",
    "inlet",
    "liquid_grid",
    "numba_particles",
    "outlet",
    "position_correction",
    "preflight",
    "pressure",
    "refill",
    "reseed",
    "rigid",
    "rigid_body",
    "rollout",
    "rollout_domain",
    "rollout_pressure",
    "rollout_surface",
    "rollout_torch",
    "rollout_torch_domain",
    "rotation",
    "stepping",
    "surface_kernels",
    "surface_tension",
    "surroundings",
    "terrain_edit",
    "terrain_reshape",
    "transfer",
    "viscosity",
    "wave_dispersion",
    "whitewater",
]  # fmt: skip
