"""What each section of docs/paper.md says; the figures come from benchmarks/results."""

from __future__ import annotations

from benchmarks.paper.page import Results, Section, Table, columns, listed, table
from benchmarks.paper.scenes import EXAMPLES, PLANS

PAPER = "paper"
STEP = "python -m benchmarks.paper --only {}"

FLOW = ("Farneback alone", "filled along the mainstream", "with the paper's constraint", "several frames, as made here")
MOTION = {"Farneback": "Farneback", "DIS": "dense inverse search", "multiframe": "over several frames",
          "mainstream": "filled", "projection": "constrained", "as made": "as made"}  # fmt: skip
OWN = {"demo": "demo", "scene_stream": "stream", "scene_pour": "pour", "scene_honey": "honey"}
TWINS = ("river", "pour", "honey")
FIELDS = ("video estimate", "random parameters", "fit, L2 only", "fit, full loss", "true parameters")
ROUTES = ("recurrent", "jacobi", "implicit")


def flow_table(results: Results) -> list[str]:
    """Errors of the shown frame."""
    subject = "flow of the made stream"
    rows = [[name, results.cell(PAPER, subject, name)] for name in FLOW]
    rows += [["mean speed of the truth", results.cell(PAPER, subject, "mean speed of the truth")]]
    return table(["frame 12 of the made stream", "mean end-point error"], rows) if rows[0][1] else []


def twin_fields(results: Results) -> list[str]:
    """Relative L2 of the fields on twins."""
    rows = [[s, *(results.cell(PAPER, f"twin: {s}", f) for f in FIELDS)] for s in TWINS]
    return table(["twin, relative L2 against the exact velocity", *FIELDS], rows) if rows[0][1] else []


def parameter_table(results: Results) -> list[str]:
    """Before, after and truth of a twin; before and after of the demo's clip."""
    out = []
    for subject, ends in (
        ("table: river twin", ("before", "after", "truth")),
        ("table: demo clip", ("before", "after")),
    ):
        names = list(dict.fromkeys(f.rpartition(", ")[0] for f in results.figures(PAPER, subject)))
        rows = [[n, *(results.cell(PAPER, subject, f"{n}, {e}") for e in ends)] for n in names]
        out += table([subject.removeprefix("table: "), *ends], rows) if rows else []
    return out


def starts_table(results: Results) -> list[str]:
    """Ends of fits from arbitrary starts."""
    names = ("inflow", "viscosity", "outflow")
    rows = [
        [s, *(" > ".join(results.cell(PAPER, s, f"{n} at the {when}") for when in ("start", "end")) for n in names)]
        for s in results.subjects(PAPER, "start ")
    ]  # fmt: skip
    return table(["demo's clip", *names], rows) if rows else []


def routes_table(results: Results) -> list[str]:
    """How far Adam and Levenberg-Marquardt come with each way through the pressure."""
    figures = ("ms per iteration", "loss over start", "parameter error over start", "iterations")
    rows = [
        [s.removeprefix("pressure route: "), *(results.cell(PAPER, s, f) for f in figures)]
        for s in results.subjects(PAPER, "pressure route: ")
    ]
    return table(["route", *figures], rows) if rows else []


def examples_table(results: Results) -> list[str]:
    """Likeness of each example to its clip."""
    figures = ("PSNR in the mask", "IoU of the mask")
    rows = [[PLANS[n].title, *(results.cell(PAPER, f"example: {n}", f) for f in figures)] for n in EXAMPLES]
    rows = [r for r in rows if any(r[1:])]
    return table(["example", *figures], rows) if rows else []


def stages_table(results: Results) -> list[str]:
    """Seconds of the stages of the demo, by length and by grid."""
    subjects = results.subjects(PAPER, "run time: ")
    if not subjects:
        return []
    stages = list(dict.fromkeys(f for s in subjects for f in results.figures(PAPER, s)))
    rows = [[f, *(results.cell(PAPER, s, f) for s in subjects)] for f in stages]
    return table(["stage", *(s.removeprefix("run time: ") for s in subjects)], rows)


def preset_table(results: Results) -> list[str]:
    """The preset paper beside draft."""
    figures = list(dict.fromkeys(f for s in results.subjects(PAPER, "preset ") for f in results.figures(PAPER, s)))
    subjects = results.subjects(PAPER, "preset ")
    rows = [[f, *(results.cell(PAPER, s, f) for s in subjects)] for f in figures]
    return table(["", *(s.removeprefix("preset ") for s in subjects)], rows) if rows else []


def smoke_table(what: str) -> Table:
    """Ours among other methods, a row each; nothing where ours was not measured."""

    def rows(results: Results) -> list[str]:
        figures = ("PSNR", "PSNR in the smoke", "IoU of the smoke", "gradient over the truth's")
        others = ("PINF", "HyFluid", "STG", "FluidNexus", "input copied")
        names = ("ours", "input copied, here", "ours, input view", *others)
        body = [[n, *(results.cell("smoke", f"{what}: {n}", f) for f in figures)] for n in names]
        return table([what, *figures], [row for row in body if any(row[1:])]) if body[0][1] else []

    return rows


SECTIONS = (
    Section(
        "teaser",
        "Teaser",
        "Four panels: a frame of a river with rocks; the asset drawn from its Gaussians; the same with another look "
        "and objects in it; that rendered.",
        "The demo clip (40 frames, 320 px): a frame, the re-simulated asset from the side, the same after two edits (a "
        "boulder and a pillar, 0.8 m more of its bed), and its surface drawn as clear water.",
        (STEP.format("teaser"), "python benchmarks/edits/01_objects_in_a_longer_river.py"),
        "The paper lifts real footage with a generator that was trained on a great many objects, and its last panel "
        "is rendered for show, at a higher resolution. Ours is a clip of the project's own, drawn at the resolution "
        "of a draft.",
        (("teaser.jpg", "The demo: input, asset from the side, edited, rendered"),),
    ),
    Section(
        "overview",
        "Overview of the stages",
        "A diagram of five stages from generated Gaussians to the rendering.",
        "The same stages with what each made of the demo: [pipeline.jpg](pictures/pipeline.jpg).",
        ("python benchmarks/pipeline_picture.py demo.fluid",),
        "The paper's second stage begins with a generated body that has a back of its own; the embedded generator here "
        "knows the visible surface and closes it by a bed or a mirror image.",
        tables=(columns("cost", {"demo, compiled": "demo, 40 frames"}, {"time": "from clip to asset"}),),
    ),
    Section(
        "refined",
        "Generated beside refined Gaussians",
        "A generated body is coarse and its large ellipses blur the picture; a fast optimisation on one view makes it "
        "sharp, and drops Gaussians that cover rocks.",
        "A body as coarse as a generator's, before and after 100 steps of the single-view optimisation; the close-up "
        "is the yellow frame. Rocks that it bridged are free again.",
        (STEP.format("refined"), "python benchmarks/refinement.py --work runs"),
        "The paper's comes from a pretrained generator and so has a plausible far side, which a single view cannot "
        "give this one.",
        (("refined.jpg", "Picture, generated and refined body, and a close-up of each"),),
        (
            columns(
                PAPER,
                {"generated beside refined": "the demo's first frame"},
                {"PSNR, generated": "generated", "PSNR, refined": "refined"},
            ),
            columns(
                "splats",
                OWN,
                {
                    "PSNR": "after all steps, input view",
                    "PSNR beside": "20 degrees beside",
                    "depth error": "depth error",
                },
            ),
        ),
    ),
    Section(
        "filled",
        "Sparse, filled, united",
        "A generated body is a sparse shell; filling puts Gaussians inside it, and a union over frames makes the bed "
        "steady.",
        "Centres near a vertical section through the middle of the demo, along the stream: blue are seen, orange "
        "inside. The gap is a rock. Without the union the far side changes several times as much from frame to frame.",
        (STEP.format("filled"), "python benchmarks/refinement.py --work runs"),
        "The paper's union joins whole bodies with backs that differ; ours joins fronts over one bed, so there is less "
        "for it to repair.",
        (("filled.png", "Section through the body of one frame, filled, and united"),),
        (
            columns(
                "splats",
                OWN,
                {"flicker, not united": "flicker of the far side, not united", "flicker of the far side": "united"},
            ),
        ),
    ),
    Section(
        "flow",
        "Flow as found, interpolated, corrected",
        "Flow vanishes in plain patches of water; interpolation along the mainstream fills them, and a projection on "
        "the screen divergence of an incompressible fluid makes them consistent.",
        "Hue is direction, strength is speed. Both of the paper's steps bring Farneback's flow nearer to the truth in "
        "the mean; met exactly, the constraint leaves spots of its own. Measuring over several frames brings more than "
        "both, and on what that leaves the constraint is met only as far as hidden patches of the clip bear it out, "
        "which on these scenes is not at all.",
        (STEP.format("flow"), "python benchmarks/motion.py --work runs"),
        "The paper shows that its corrected field looks right; it gives no errors, so neither is known to be better. "
        "Learned flow (RAFT, SEA-RAFT), which neither uses by default, was not compared; here it is an option that "
        "needs weights.",
        (("flow.jpg", "Flow of the made stream by Farneback, filled, constrained, as made, and the truth"),),
        (flow_table, columns("motion", OWN, MOTION)),
    ),
    Section(
        "layer",
        "Boundary layer",
        "A sketch, and a section through a volume velocity that fades towards the river bed by a polynomial of third "
        "order.",
        "Sections through the demo's volume velocity, along the stream and across it (grey is ground), and the mean "
        "speed above the bed beside the paper's polynomial. The projection afterwards evens out what columns alone "
        "would hold.",
        (STEP.format("layer"),),
        "Nothing to compare: the paper gives no profile. A logarithmic law, which hydraulics has for rivers, is "
        "`--set motion.wall=log`.",
        (("layer.png", "Sections through the volume velocity, and its profile above the bed"),),
        (listed(PAPER, "boundary layer of the demo"),),
    ),
    Section(
        "pressure",
        "The convolution that solves for the pressure",
        "A recurrent convolution is fitted to an implicit solver's pressures; then a fit through it is shown to "
        "converge faster than through Jacobi sweeps or an analytic gradient, at several batch sizes.",
        "The same comparison on a twin: loss and parameter error over iterations and over seconds. As in the paper, "
        "the convolution beats Jacobi, whose unfinished pressure ends at wrong parameters however long one waits. The "
        "analytic gradient gives the same descent as the convolution for a fraction of the time, so it is the "
        "default, and Levenberg-Marquardt on it needs a handful of iterations.",
        (STEP.format("pressure"), "python benchmarks/pressure_routes.py --figure routes.png --json routes.json"),
        "Per iteration the paper's convolution is faster than its analytic gradient. On this twin it is not: they are "
        "the same gradient. The paper's solver runs on a GPU, where a convolution is cheap; that was not compared.",
        (("pressure.png", "Loss and parameter error of each route; fit and validation of the convolution"),),
        (routes_table, listed(PAPER, "fitted convolution")),
    ),
    Section(
        "resimulated",
        "Input, re-simulation, rendering",
        "A frame of the clip, the re-simulated Gaussians in the same view, and the same rendered.",
        "Frame 14 of the demo. In the middle the clip's own film plays on a skin over the particles; on the right the "
        "surface is clear water, through which the bed is seen.",
        (STEP.format("resimulated"), "python benchmarks/as_filmed.py --make CLIP"),
        "The paper's rendering shows foam and waves; ours is a clear liquid without foam under the light of an empty "
        "sky, and looks darker and duller than its clip.",
        (("resimulated.jpg", "The clip, its re-simulation, and a rendering of it"),),
        (
            columns(
                "cases",
                {"demo": "demo"},
                {
                    "resimulated psnr_fluid.fitted": "PSNR in the fluid, fitted frames",
                    "resimulated psnr_fluid.predicted": "later frames",
                    "resimulated mask_iou.fitted": "IoU, fitted frames",
                    "resimulated mask_iou.predicted": "IoU, later frames",
                },
            ),
        ),
    ),
    Section(
        "examples",
        "Eight examples",
        "Five thin liquids and three viscous ones from real clips: input, re-simulation, and a view from the side.",
        "Eight scenes that the project simulates and films: five thin liquids, three viscous ones; input, "
        "re-simulation in the same view, side view. Each is a draft of about a second, with the camera given.",
        (STEP.format("examples"),),
        "The paper's eight are real footage, ours are made: light, foam and murk of real water are harder. What drafts "
        "of real clips come to, with masks drawn by hand beside: [results](results.md#as-filmed), "
        "[hints](results.md#with-a-persons-hints). Some of ours are worse: the pour's jet comes apart, the fall is "
        "thinner than filmed, and the dam throws up a spout at its pillar that is not in the clip and is a smear from "
        "the side.",
        (("examples.jpg", "Eight made scenes: input, re-simulation, side view"),),
        (examples_table,),
    ),
    Section(
        "fields",
        "Volume velocity: video, random, L2, full loss",
        "Four volume velocities: of the video, of a simulation with random parameters (the fluid runs over its bed), "
        "of parameters fitted by the squared error alone, and by the full loss.",
        "The demo's clip: speed in one layer of cells after six frames, each rolled out from the video's first. Random "
        "parameters are half to twice the speed, a tenth to ten times the viscosity, gravity 15 degrees off; of five "
        "draws the middle one. Below, what the particles do under it: the demo's banks are high, so its water does not "
        "run over them as the paper's does but leans to one side and drains. On twins, where the exact velocity is "
        "known, the fit comes down to the error of its starts; the term of direction, the paper's full loss, brings "
        "nothing measurable.",
        (STEP.format("fields"), "python benchmarks/fit_study.py --seeds 1 --parts table comparison"),
        "In the paper the full loss is visibly better than the squared error alone. Here both are the same, so the "
        "paper gets more out of it.",
        (
            ("fields.png", "Speed and direction in a layer of the demo, four ways"),
            ("overflow.jpg", "Particles after 1.6 s under fitted and random parameters"),
            ("twins.png", "The four fields on twins, beside the exact one"),
        ),
        (
            columns(
                PAPER,
                {"volume velocity of the demo's clip": "demo, against the video"},
                {
                    "relative L2, random parameters": "relative L2, random",
                    "relative L2, L2 alone": "L2 alone",
                    "relative L2, full loss": "full loss",
                    "volume at the end over the first, random parameters": "volume at the end, random",
                    "volume at the end over the first, fitted parameters": "volume at the end, fitted",
                    "fluid outside its bed, random parameters": "outside the bed, random",
                    "fluid outside its bed, fitted parameters": "outside the bed, fitted",
                },
            ),
            twin_fields,
        ),
    ),
    Section(
        "parameters",
        "Table 1: parameters before and after",
        "Scales of velocity, pressure, gravity, time step, inflow, outflow and bouncing before and after the fit: most "
        "end an order of magnitude below their start.",
        "A twin with its truth, and the demo's clip; values, not scales. What a clip cannot tell keeps its prior: "
        "density only scales the pressure, gravity is what it is everywhere, and the time step is chosen.",
        (STEP.format("parameters"), "python benchmarks/fit_study.py --seeds 1 --parts table comparison"),
        "The paper fits gravity, time step and density freely; ours holds them near what is known. Where the size of a "
        "scene is wrong, the paper's gravity can make up for it, ours cannot.",
        tables=(parameter_table,),
    ),
    Section(
        "starts",
        "Convergence from arbitrary starts",
        "In the text: from arbitrary plausible starts the parameters converge to the same values.",
        "The demo's clip, fitted from starts of arbitrary scale (start > end). Inflow and outflow end together; "
        "viscosity, of which a second of smooth water tells nothing, stays where it began and is reported as not "
        "determined.",
        (STEP.format("starts"),),
        "The paper says so of all its clips, ours is one; on twins all of 48 fits from eight starts end within 1.1 % "
        "([experiments](experiments/2026-11-fit.md#twin-experiments)).",
        tables=(starts_table, listed(PAPER, "arbitrary starts")),
    ),
    Section(
        "planar",
        "Planar velocity: truth, estimate, re-simulation",
        "Two made videos, a river and honey: planar velocity of the truth, as estimated, and of the re-simulation, "
        "which the paper finds smoother and nearer in detail.",
        "The same on a made stream and honey, with errors in pixels per frame.",
        (STEP.format("planar"), "fluidlift evaluate ASSET --truth CASE"),
        "In the paper the re-simulation corrects the estimate. Here the estimate is nearer to the truth than the "
        "re-simulation: the physics of a draft on 64 cells is the weaker witness, and the paper's claim does not hold "
        "for ours.",
        (("planar.jpg", "Planar velocity of truth, estimate and re-simulation"),),
        (
            columns(
                PAPER,
                {f"planar velocity, {n}": n for n in ("stream", "honey")},
                {
                    "error, estimate": "error of the estimate",
                    "error, re-simulation": "of the re-simulation",
                    "cosine, estimate": "cosine of the estimate",
                    "cosine, re-simulation": "of the re-simulation",
                    "mean speed of the truth": "speed of the truth",
                },
            ),
        ),
    ),
    Section(
        "study",
        "User study, and what stands in for it",
        "Fifteen artists rate the paper's results above a body generated for every frame by itself, in likeness, "
        "realism and beauty.",
        "No people were asked. Measured in its place, over six frames of the demo: a body of each frame by itself, "
        "refined on it, against the re-simulation. Flicker is the mean second difference in time.",
        (STEP.format("study"),),
        "A body per frame is far more like its frame (it is made of it), and here it flickers no more than ours, since "
        "the embedded generator gives every frame the same depth. What it lacks is an inside, a motion and an end: "
        "nothing can be simulated or edited. People's judgement of realism is not measured, nor a pretrained "
        "generator, whose far side changes from frame to frame.",
        (("per_frame.jpg", "The clip; each frame by itself and ours, in the clip's view and from the side"),),
        (
            columns(
                PAPER,
                {"the clip": "the clip", "each frame by itself": "each frame by itself", "ours": "ours"},
                {
                    "PSNR": "PSNR",
                    "flicker": "flicker",
                    "flicker from the side": "from the side",
                    "crispness": "crispness",
                },
            ),
        ),
    ),
    Section(
        "generators",
        "Other generators",
        "TriplaneGaussian in all examples but one, TRELLIS in that one: the first keeps to the picture, the second is "
        "finer and freer.",
        "",
        ("fluidlift generators",),
        "The paper ran both. Adapters for these and three more are here and their conventions are tested with bodies "
        "of known shape, but none was run with its weights.",
        missing="They need weights of gigabytes and a GPU; neither is part of this project.",
    ),
    Section(
        "edits",
        "Edits",
        "Objects in a longer river; another look with gravity turned; another texture, a twisted terrain, a stream "
        "that meets what is put into it.",
        "The paper's three, and three more; each is a script with checks, and a few lines of "
        "[editing.md](editing.md#six-edits-to-try).",
        (STEP.format("edits"), "python benchmarks/edits/01_objects_in_a_longer_river.py"),
        "The paper renders its edits in a production renderer at high resolution; ours are drawn by the program in "
        "seconds.",
        (("edits.jpg", "Six edits of the demo"),),
        (
            columns(
                "cost",
                {"loop of the demo": "loop", "viewer, an edit": "viewer"},
                {"step at the seam": "step at a loop's seam", "to the first changed frame": "first changed frame"},
            ),
        ),
    ),
    Section(
        "time",
        "Run time",
        "Seconds of each component for the example of the teaser, on a logarithmic scale: the fit dominates, and grows "
        "with the length of the clip and the density of the grid.",
        "Seconds of wall time of each stage of the demo, by length and by grid, on two cores that had other work as "
        "well, so that shares count and not seconds. The re-simulation takes most, the fit comes next and is bounded "
        "by its work; both grow with length and grid.",
        (STEP.format("time"), "python benchmarks/farm_costs.py --preset standard"),
        "The paper's simulation runs on a GPU in real time. Ours does on one too "
        "([results](results.md#on-a-gpu)), but not on the machine of this table.",
        tables=(
            stages_table,
            columns(
                "farm",
                {"demo, 40 frames, draft": "draft", "demo, 40 frames, standard": "standard"},
                {"processor time": "demo, 40 frames: processor time", "memory": "memory"},
            ),
        ),
    ),
    Section(
        "preset",
        "The paper's own configuration",
        "Farneback's flow, its interpolation and exact constraint, a convolution for the pressure, Adam on the last "
        "frame, deformed Gaussians.",
        "`--preset paper` does all that from end to end; the demo by it and by the default, with the camera given to "
        "both, scored against the truth. Colours that particles carry are stirred into streaks, which the skin "
        "avoids.",
        (STEP.format("preset"), "fluidlift make CLIP --preset paper"),
        "It is the paper's method with our generator, our grid and our weights of the losses, which the paper does not "
        "give; the authors' own program may do better than this.",
        (("preset.jpg", "The demo by the default and by the paper's configuration"),),
        (preset_table,),
    ),
    Section(
        "river",
        "A surveyed river, beside RIVeR and OpenPIV",
        "Nothing of the kind: no figure of the paper is in metres.",
        "RIVeR's example *Pisco*, 30 frames of a torrent from a bridge, with a surveyed section. Surface velocities of "
        "the same frames, by the map that came with it; those of RIVeR are its own, of finer pictures. Discharge is "
        "velocity times surveyed depth (alpha 1), by one sum for all; RIVeR itself makes 50.5 ± 9.1 m3/s of its "
        "nodes. Velocities and discharges are estimates, the depth is a measurement. The asset is a draft of the clip "
        "alone, at the size at which the surveyed section is as long as surveyed: how deep a river is cannot be seen, "
        "so its depth is a guess, and its discharge with it. OpenPIV is GPL, ran in an environment of its own, "
        "and is no part of this program.",
        ("python benchmarks/surveyed_river.py pisco.fluid --openpiv PYTHON",),
        "OpenPIV is nearer to RIVeR than ours is, and ours is 1.07 times as fast as OpenPIV: nobody has measured which "
        "is right. Through the surveyed section all agree within RIVeR's error, so who only wants a discharge is as "
        "well served by them. The asset's own bed is wrong: its sections have nearly three times the surveyed area, "
        "for its depth is a fifth of the width that it assumes, with a flat bed between steep banks, and a "
        "third of the speed (RIVeR: 2.36 m/s); that its discharge comes out near is two errors in one product. With "
        "a camera by the case's map (--camera) the speed is 2.1 m/s, the depth 1.5 m and the discharge 118 m3/s.",
        tables=(
            columns(
                "river",
                {"RIVeR": "RIVeR", "OpenPIV": "OpenPIV", "ours": "ours"},
                {
                    "speed over RIVeR's, median of nodes": "speed over RIVeR's, median of 263 nodes",
                    "direction against RIVeR's, median cosine": "direction, median cosine",
                    "nodes within 25 % of RIVeR's speed": "nodes within 25 %",
                    "discharge through the surveyed section, alpha 1": "discharge through the surveyed section",
                    "discharge given out": "as given out",
                },
            ),
            columns(
                "river",
                {"survey": "surveyed", "our asset": "our asset"},
                {
                    "greatest depth over width": "greatest depth over width",
                    "greatest depth": "greatest depth",
                    "area of its sections": "area of its sections",
                    "discharge of its own bed": "discharge of its own bed",
                    "mean speed": "mean speed",
                },
            ),
        ),
    ),
    Section(
        "smoke",
        "Smoke, and other methods on the same pictures",
        "The paper names smoke as future work, and compares with no other method but a body per frame.",
        "A plume of ScalarFlow (HyFluid's *ScalarReal*), lifted from train02 alone on a CPU and drawn from views 00, "
        "01, 03 and 04, in films of 288 x 512 px. The others also saw one view; theirs were measured on the tiles of "
        "FluidNexus' project page, 640 x 1156 px, before this page was written and not anew. How much the size does is "
        "seen in the copied input, which stands there for both. Ours is one re-simulation that begins at frame 27, "
        "where there is enough smoke: before, it shows none, which counts; others reconstruct each frame. Told are "
        "focal length, tilt and the middle of the authors' box. "
        "In what is smoke and what is not, ours is nearer than PINF, HyFluid and STG, and so in the whole picture, if "
        "by little: once each is held against its copied input, it is level with HyFluid. The second table is made of "
        "the first 60 frames and scored in the 60 after them, for which nothing was seen.",
        ("python benchmarks/scalarflow.py ScalarReal", "python benchmarks/scalarflow.py ScalarReal --until 60"),
        "FluidNexus, with a video model that was trained on such plumes, is far ahead in nearly every figure. HyFluid "
        "and PINF are better than ours in brightness within the smoke. The input, copied into the other views, "
        "covers the true smoke as well as ours does, since a plume is round. Ours plays the film that it "
        "has seen, and turns to another side what is round there: its curls are as sharp as the true ones and lie "
        "elsewhere, which costs brightness in the smoke (an opaque body without any had 13.7 dB).",
        tables=(smoke_table("new views"), smoke_table("foretold from 60 frames")),
    ),
)
