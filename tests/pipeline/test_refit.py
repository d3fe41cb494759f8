"""The parameters of a finished asset are fitted again: with known values, after failures, without touching edits."""

import json
import math
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.cli import DONE, FAILED, REJECTED, WITH_WARNINGS, main
from fluidlift.fit import optimize
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.types import kind_of
from fluidlift.validate import validate_asset

WELL = (DONE, WITH_WARNINGS)
EDITED = "parameters: {density: 1100}\n# my own words\n"


@pytest.fixture(scope="module")
def made(stream_clip, tmp_path_factory):
    """The small clip as a coarse asset whose fit had no time."""
    folder = tmp_path_factory.mktemp("coarse") / "stream.fluid"
    coarse = ("--set", "shape.cells=14", "--set", "shape.refine_iterations=0", "--set", "motion.targets=2",
              "--set", "fit.max_seconds=0", "--set", "simulate.frames=3", "--set", "show.usd=false")  # fmt: skip
    code = main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *coarse])
    return SimpleNamespace(clip=stream_clip, folder=folder, options=coarse, code=code)


@pytest.fixture
def asset(made, tmp_path):
    """A copy of the asset, with a scene.yaml that somebody edited."""
    folder = shutil.copytree(made.folder, tmp_path / "stream.fluid")
    (folder / "scene.yaml").write_text(EDITED, encoding="utf-8")
    return folder


@pytest.fixture
def outcome(monkeypatch):
    """Lets the fit end in a chosen way: changes of a good result, or an exception."""

    def end(changes=None, *, error=None, calls=None, **extra):
        def fit(targets, cells, terrain, grid, interval, initial, *, settings, restarts=1, **options):
            options |= vars(settings) | {"restarts": restarts}
            if calls is not None:
                calls.append((initial, settings.free, options))
            if error is not None:
                raise error
            from fluidlift.fit.outcome import first_guess_as_result
            from fluidlift.fit.ranges import UNITS
            from fluidlift.types import Estimate, FitResult

            found = replace(initial, outflow_velocity=0.123, kinematic_viscosity=2e-5)
            known = {"outflow_velocity": Estimate(0.123, 0.01, True, initial.outflow_velocity, "m/s")}
            figures = {"loss": 0.1, "loss_at_prior": 1.0, "loss_at_rest": 2.0} | extra
            good = FitResult(found, first_guess_as_result(found, UNITS) | known, np.ones(2), True, 9, (), figures)
            return replace(good, **(changes or {}))

        monkeypatch.setattr(optimize, "fit_parameters", fit)

    return end


def fit(folder, *options):
    return main(["fit", str(folder), *options])


def parameters(folder):
    return load_asset(folder).parameters


def rows(folder):
    return {r["name"]: r for r in read_manifest(folder)["metrics"]["fit"]["table"]}


def files(folder, *but):
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and p.name not in but}


# what it does ---------------------------------------------------------------------------------------------------


def test_a_fit_without_time_is_a_warning_and_keeps_the_first_guess(made):
    assert made.code == WITH_WARNINGS
    manifest = read_manifest(made.folder)
    assert any("fit failed" in w and "max_seconds" in w for w in manifest["warnings"])
    assert manifest["metrics"]["fit"]["status"] == "failed"
    assert "The fit failed" in (made.folder / "report.html").read_text(encoding="utf-8")
    assert parameters(made.folder).kinematic_viscosity == kind_of("stream").kinematic_viscosity


def test_a_real_fit_of_a_finished_asset_finds_the_outflow(asset, capsys):
    """The clip flows as fast as before; only the time was missing."""
    before = parameters(asset)
    capsys.readouterr()
    assert fit(asset, "--max-seconds", "60", "--json") in WELL
    found = json.loads(capsys.readouterr().out)
    assert found["status"] in ("fitted", "unfinished")
    known = {r["name"]: r for r in found["parameters"]}
    assert known["outflow_velocity"]["before"] == pytest.approx(before.outflow_velocity)
    assert any(r["source"].startswith("fitted") for r in known.values())
    assert known["density"]["source"] == "prior: not determined by the clip"
    # a stream of even texture leaves about as fast as it comes
    assert parameters(asset).inflow_velocity[0] == pytest.approx(before.inflow_velocity[0], rel=0.5)


def test_only_parameters_manifest_and_report_change(asset, outcome):
    touched = ("parameters.json", "manifest.json", "report.html", ".writing")  # the last says who wrote last
    before = files(asset, *touched)
    outcome()
    assert fit(asset) in WELL
    after = files(asset, *touched)
    changed = {p for p in before.keys() | after.keys() if before.get(p) != after.get(p)}
    assert {p.relative_to(asset).parts[:2] for p in changed} == {("work", "fit")}
    assert (asset / "scene.yaml").read_text(encoding="utf-8") == EDITED
    assert parameters(asset).outflow_velocity == 0.123
    assert not [f for f in validate_asset(asset) if not f.passed]


def test_the_table_says_before_and_after_and_what_to_do_next(asset, outcome, capsys):
    outcome()
    capsys.readouterr()
    fit(asset)
    said = capsys.readouterr().out
    (line,) = [x for x in said.splitlines() if x.startswith("outflow_velocity")]
    assert "0.123" in line and "0.103 to 0.143" in line and line.endswith("fitted")
    assert "fluidlift sim" in said
    # scene.yaml stands over what was fitted
    assert "scene.yaml sets density = 1100" in said
    assert "scale: 2 m across the fluid, as given" in said


def test_a_good_fit_takes_the_warning_of_the_bad_one_away(asset, outcome):
    outcome()
    fit(asset)
    assert not {"fit-failed", "fit-unfinished"} & set(read_manifest(asset)["warning_codes"])
    text = (asset / "report.html").read_text(encoding="utf-8")
    assert "The fit converged" in text and "fluidlift sim plays these" in text


def test_sim_plays_the_fitted_values(asset, outcome):
    outcome()
    fit(asset)
    assert main(["sim", str(asset), "--set", "show.usd=false"]) in WELL
    shown = read_manifest(asset)["simulation"]["parameters"]
    assert (shown["outflow_velocity"], shown["density"]) == (0.123, 1100)
    assert "fluidlift sim plays these" not in (asset / "report.html").read_text(encoding="utf-8")


def test_the_parameter_file_says_where_each_number_comes_from(asset, outcome):
    outcome()
    fit(asset, "--hold", "viscosity=1e-6")
    found = load_asset(asset).estimates
    assert found["outflow_velocity"].source == "fitted"
    assert found["outflow_velocity"].interval == pytest.approx((0.123 - 0.0196, 0.123 + 0.0196))
    assert (found["kinematic_viscosity"].source, found["kinematic_viscosity"].interval) == ("given", (1e-6, 1e-6))
    assert (found["density"].source, found["density"].interval) == ("prior: not determined by the clip", None)


# known values ---------------------------------------------------------------------------------------------------


def test_a_known_value_is_kept_and_not_fitted(asset, outcome):
    calls = []
    outcome(calls=calls)
    assert fit(asset, "--hold", "viscosity=1e-6", "--hold", "inflow_velocity=0.4") in WELL
    initial, free, _ = calls[0]
    assert initial.kinematic_viscosity == 1e-6 and "kinematic_viscosity" not in free and "gravity" in free
    # the fit made up another one; what is known stays
    assert parameters(asset).kinematic_viscosity == 1e-6
    assert np.linalg.norm(parameters(asset).inflow_velocity) == pytest.approx(0.4)
    found = rows(asset)
    assert (found["kinematic_viscosity"]["source"], found["kinematic_viscosity"]["sigma"]) == ("given", 0.0)
    assert found["inflow_velocity_x"]["source"] == "given"


def test_a_known_zero_stays_zero(asset, outcome):
    outcome()
    fit(asset, "--hold", "outflow=0")
    assert parameters(asset).outflow_velocity == 0.0


def test_known_values_stay_known_in_the_next_fit_until_they_are_let_go(asset, outcome):
    calls = []
    outcome(calls=calls)
    fit(asset, "--hold", "viscosity=1e-6")
    fit(asset)
    assert calls[1][0].kinematic_viscosity == 1e-6
    fit(asset, "--set", "fit.hold=null")
    assert calls[2][0].kinematic_viscosity == kind_of("stream").kinematic_viscosity


def test_only_what_is_asked_for_is_fitted(asset, outcome):
    calls = []
    outcome(calls=calls)
    fit(asset, "--free", "viscosity,damping", "--method", "adam", "--max-seconds", "3")
    _, free, options = calls[0]
    assert free == ("kinematic_viscosity", "wall_damping")
    assert (options["method"], options["max_seconds"]) == ("adam", 3.0)
    assert rows(asset)["gravity_z"]["source"] == "prior: not fitted"


def test_walls_are_fitted_only_where_asked_for(asset, outcome):
    calls = []
    outcome(calls=calls)
    fit(asset)
    fit(asset, "--free", "wall_damping")
    assert [("wall_damping" in free, "restitution" in free) for _, free, _ in calls] == [(False, False), (True, False)]


def test_restarts_are_further_fits(asset, outcome):
    calls = []
    outcome(calls=calls)
    fit(asset, "--restarts", "3")
    fit(asset, "--set", "fit.restarts=0")
    assert [options["restarts"] for *_, options in calls] == [4, 1]


def test_the_size_stands_beside_the_parameters_that_hang_on_it(asset, outcome):
    outcome()
    fit(asset)
    size = rows(asset)["size"]
    assert (size["value"], size["unit"], size["source"], size["sigma"]) == (2.0, "m", "given", 0.0)
    assert load_asset(asset).estimates["size"].value == 2.0


def test_make_takes_the_same_settings(asset, made, outcome):
    calls = []
    outcome(calls=calls)
    more = ("--set", "fit.hold=[density=998]", "--set", "fit.free=density_")
    assert main(["make", str(made.clip), "-o", str(asset), "--size", "2", *made.options, *more]) == REJECTED
    assert main(["make", str(made.clip), "-o", str(asset), "--size", "2", *made.options, *more[:2]]) in WELL
    assert len(calls) == 1 and calls[0][0].density == 998.0 and "density" not in calls[0][1]
    assert parameters(asset).density == 998.0


# failure --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ending", "reason"),
    [
        ({"loss": 1.5}, "worse than the first guess"),
        ({"loss": 0.9, "loss_at_rest": 0.3}, "still water"),
        ({"loss": math.inf}, "breaks down"),
        ({"changes": {"estimates": {}}}, "determines none"),
        ({"error": np.linalg.LinAlgError("Singular matrix")}, "Singular"),
    ],
    ids=["worse", "rest", "broken", "nothing", "singular"],
)
def test_a_failed_fit_keeps_the_first_guess_and_says_why(asset, outcome, capsys, ending, reason):
    outcome()
    fit(asset)  # a good fit before, which a bad one does not leave in place by chance
    outcome(**ending)
    capsys.readouterr()
    assert fit(asset, "--hold", "density=998", "--json") == WITH_WARNINGS
    said = capsys.readouterr()
    assert reason in said.err and "fit failed" in said.err
    found = json.loads(said.out)
    assert found["status"] == "failed" and reason in found["reason"]
    kept = parameters(asset)
    assert kept.outflow_velocity not in (0.0, 0.123)
    assert kept.kinematic_viscosity == kind_of("stream").kinematic_viscosity
    assert kept.density == 998.0  # what a person knows is known, fit or no fit
    sources = {r["source"] for r in found["parameters"]}
    assert "fitted" not in sources and {"given", "measured"} < sources
    assert any(reason in w for w in read_manifest(asset)["warnings"])
    assert not [f for f in validate_asset(asset) if not f.passed]


def test_a_fit_that_is_cut_off_keeps_the_best_so_far(asset, outcome):
    outcome({"converged": False})
    assert fit(asset) == WITH_WARNINGS
    assert parameters(asset).outflow_velocity == 0.123
    assert "did not converge" in (asset / "report.html").read_text(encoding="utf-8")


def test_an_interrupted_fit_changes_nothing(asset, outcome):
    before = files(asset)
    outcome(error=KeyboardInterrupt())
    assert fit(asset) == FAILED
    lock = ".writing"  # says who wrote last; the lock itself ended with the fit
    assert files(asset, lock) == {p: b for p, b in before.items() if p.name != lock}


# what cannot be fitted again --------------------------------------------------------------------------------------


def rejected(capsys, folder, *options):
    before = files(folder)
    capsys.readouterr()
    assert fit(folder, *options) == REJECTED
    assert files(folder) == before
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


def test_an_asset_without_its_work_folder_says_what_to_do(asset, capsys):
    shutil.rmtree(asset / "work")
    said = rejected(capsys, asset)
    assert "work/read" in said and "fluidlift make CLIP -o stream.fluid" in said


def test_an_asset_that_lost_one_stage_says_which(asset, capsys):
    shutil.rmtree(asset / "work" / "motion")
    assert "work/motion" in rejected(capsys, asset)


def test_an_asset_of_another_version_says_so(asset, capsys):
    manifest = json.loads((asset / "manifest.json").read_text())
    manifest["provenance"]["versions"]["fluidlift"] = "0.0.1"
    manifest["provenance"]["stages"]["motion"] = "0" * 64
    (asset / "manifest.json").write_text(json.dumps(manifest))
    assert "made by fluidlift 0.0.1" in rejected(capsys, asset)


def test_a_report_that_cannot_be_made_again_is_left_as_it_is(asset, outcome):
    """Frames may have been deleted with their cache; the fit needs none."""
    for name in ("show", "simulate", "refine"):
        shutil.rmtree(asset / "work" / name)
    report = (asset / "report.html").read_bytes()
    outcome()
    assert fit(asset) in WELL
    assert (asset / "report.html").read_bytes() == report
    assert parameters(asset).outflow_velocity == 0.123


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--hold", "viscosty=1"], "viscosty"), (["--hold", "viscosity"], "name=value"), (["--free", "velocity"], "or"),
        (["--free", "density", "--hold", "density=1"], "--hold"), (["--set", "simulate.frames=3"], "no effect"),
        (["--max-seconds", "-1"], "fit.max_seconds"), (["--restarts", "-1"], "fit.restarts"),
        (["--restarts", "5"], "fit.restarts"), (["--set", "fit.device=abacus"], "fit.device"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)  # fmt: skip
def test_wrong_options_are_named_and_nothing_is_changed(asset, capsys, options, word):
    assert word in rejected(capsys, asset, *options)
