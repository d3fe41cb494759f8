"""The page put together: one thread draws, the panels only say what is wanted."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.pipeline.preview import LivePreview, PreviewFrame, PreviewRequest, PreviewSize, Take, obstacles_of
from fluidlift.viewer.coloring import colored
from fluidlift.viewer.comparing import Comparison
from fluidlift.viewer.controls import controls_of
from fluidlift.viewer.draft import Draft, Session
from fluidlift.viewer.footage import InputPictures, input_pictures
from fluidlift.viewer.frames import FrameCache, FrameMissing, SplatFrame, read_frame, splat_frame
from fluidlift.viewer.jobs import Jobs
from fluidlift.viewer.panels import Panels
from fluidlift.viewer.ports import FIRST_PORT, free_port, is_local, open_server, require_viser
from fluidlift.viewer.saved import SavedFrames
from fluidlift.viewer.stage import Stage, VisibleLayers
from fluidlift.viewer.timeline import Timeline

LOG = logging.getLogger(__name__)
TICKS = 30.0
"""1/s: how often the page is brought up to date"""
WATCHED = 1.0
"""s between two looks at the files of the asset"""
SAVED, LIVE = "saved frames", "live preview"


@dataclass(frozen=True)
class ViewRequest:
    """How an asset is shown."""

    host: str = "127.0.0.1"
    """address that the server listens on; others than this machine's own let the network in"""
    port: int = FIRST_PORT
    """the next free one is taken where it is not"""
    browser: bool = False
    """open the page in the default browser"""


def open_session(folder: Path) -> Session:
    """The edits of an asset."""
    from fluidlift.scene.edits import EditSession

    return EditSession.open(folder)


def view_asset(folder: Path, request: ViewRequest | None = None, *, told: Callable[[str], None] = print) -> None:
    """Show an asset in the browser until the process is interrupted.

    Args:
        folder: of the asset.
        request: where.
        told: takes lines for a person.

    Raises:
        MissingPackage: viser is not installed.
        InputRejected: no asset, or no port is free.
    """
    viewer = Viewer(folder, request or ViewRequest())
    try:
        for line in viewer.lines():
            told(line)
        if viewer.request.browser:
            webbrowser.open(viewer.address)
        while viewer.alive:
            time.sleep(0.2)
    except KeyboardInterrupt:
        told("closed")
    finally:
        viewer.close()


class Viewer:
    """One asset, one server, any number of browsers.

    Args:
        folder: of the asset.
        request: where it is shown.
        size: of the live preview; None: as this machine bears it.

    Raises: as `view_asset`.
    """

    def __init__(self, folder: Path, request: ViewRequest, size: PreviewSize | None = None) -> None:
        require_viser()
        self.folder, self.request, self.lock = folder, request, threading.RLock()
        self.saved = SavedFrames(folder)
        self.asset = self.saved.asset
        self.draft = Draft(open_session(folder), self.asset.parameters)
        self.controls = controls_of(self.asset.parameters, self.asset.kind, self.asset.estimates)
        self.cache: FrameCache[SplatFrame] = FrameCache(self._read)
        self.pictures: InputPictures | None = None
        self.looking_for_pictures = True
        self.timeline = Timeline(self.saved.count, self.saved.interval)
        self.parts, self.source, self.messages = VisibleLayers(), SAVED, ""
        self.take: Take | None = None
        self.fastest = 0.0
        """m/s, of the frame in view"""
        self.chosen = ""
        """name of the obstacle that is being edited"""
        self._bodies: tuple[Any, ...] = ()
        self._bodies_of: list[Any] | None = None
        self._drawn: tuple[Any, ...] = ()
        self._dirty = self.alive = True
        self._failures = 0
        self.comparison = Comparison(self)
        self.preview = LivePreview(self.asset, folder, size=size, keep=_kept, told=self._preview_told)
        self.jobs = Jobs(self._job_ended)
        port = free_port(request.host, request.port)
        self.server, self._secret = open_server(request.host, port, f"fluidlift · {folder.name}")
        self.stage = Stage(self.server, folder, self.asset, self.redraw)
        self.panels = Panels(self)
        self.stage.look_from_input(self.server.initial_camera)
        self.server.on_client_connect(self.stage.keep_whole)
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()
        self.preview.start()
        self.comparison.start()
        threading.Thread(target=self._find_pictures, name="input video", daemon=True).start()

    # what is told

    @property
    def address(self) -> str:
        """Of the page; who knows it is let in."""
        host = "127.0.0.1" if self.request.host in ("0.0.0.0", "localhost") else self.request.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}/{self._secret}"

    def lines(self) -> list[str]:
        """What a person at the terminal should know."""
        found = [f"{self.folder.name}: {self.address}   (Ctrl-C closes it)"]
        port = self.server.get_port()
        if port != self.request.port:
            found.append(f"port {self.request.port} is in use; {port} is taken instead")
        if not is_local(self.request.host):
            found.append(
                f"warning: on {self.request.host} everybody in the network who has this address can change the scene "
                "and write files into the asset, and it is sent unencrypted; 127.0.0.1 is for this machine alone"
            )
        if not self.saved.count:
            found.append(f"no simulated frames yet: press 'simulate in full', or run fluidlift sim {self.folder}")
        return found

    def say(self, text: str) -> None:
        """Tell a person something, in the page; empty: nothing any more."""
        self.messages = text
        self._dirty = True

    @property
    def stale(self) -> set[str] | None:
        """What the saved frames no longer show of the scene; None: not known yet."""
        return self.comparison.stale

    # what panels ask for

    def redraw(self) -> None:
        """Something about how it is shown has changed."""
        self._dirty = True

    def set_parts(self, **changes: bool) -> None:
        """Show more or less."""
        with self.lock:  # both at once: of two quick clicks the later one stays
            self.parts = replace(self.parts, **changes)
            self.panels.show_parts(changes)
        self._dirty = True

    def set_source(self, source: str) -> None:
        """Show saved frames, or the live preview where there is one."""
        with self.lock:
            if source == LIVE and self.take is None:
                self.say("There is no live preview yet: change something first.")
                source = SAVED
            self.source = source
            if source == LIVE and self.take is not None:
                self.timeline.resize(len(self.take.frames), self.take.interval)
            else:
                self.timeline.growing = False
                self.timeline.resize(self.saved.count, self.saved.interval)
            self._dirty = True

    def changed(self) -> None:
        """The scene is another one: simulate it live, unless the machine is taken."""
        self._dirty = True
        self.preview.ask(PreviewRequest(self.draft.scene, self.draft.last))

    def edited(self, act: Callable[[], None], done: str = "", *, moves: bool = True) -> bool:
        """Do an edit and tell how it went; whether it went well."""
        try:
            act()
        except (FluidliftError, OSError) as error:
            self.say(str(error))
            return False
        finally:
            self.panels.refresh()
        self.say(done)
        if moves:
            self.changed()
        return True

    def refused(self) -> bool:
        """Whether the files of the asset may not be changed now; says why."""
        if self.jobs.running:
            self.say(f"{self.jobs.state.name} is under way: stop it, or wait for its end.")
        elif self.saved.foreign:
            self.say("Another process is writing this asset: wait until it is done.")
        else:
            return False
        return True

    # the drawing thread

    def _run(self) -> None:
        watched = 0.0
        while self.alive:
            began = time.monotonic()
            try:
                if began - watched > WATCHED:
                    watched = began
                    self._watch()
                self._tick(began)
            except Exception as error:
                self._failures += 1
                self.surprised("drawing the page", error, trace=self._failures == 1)
                time.sleep(min(0.1 * self._failures, 2.0))
            time.sleep(max(1.0 / TICKS - (time.monotonic() - began), 0.002))

    def _tick(self, now: float) -> None:
        if self.draft.pending:
            self._settle(now)
        if not self.server.get_clients():  # nobody looks: time stands still, and nothing is read
            self.timeline.seek(self.timeline.frame, now)
            return
        with self.lock:
            self._follow_preview()
            frame = self.timeline.tick(now)
            state = (self.source, frame, id(self.take), self.parts, self.chosen)
        dirty, self._dirty = self._dirty, False
        if dirty or state != self._drawn:
            self._drawn = state
            self._draw(frame)
        self.panels.tick()

    def _settle(self, now: float) -> None:
        try:
            if self.draft.settle(now):
                self.panels.refresh()
        except FluidliftError as error:
            self.say(str(error))
            self.panels.refresh()
            self.changed()

    def _follow_preview(self) -> None:
        """Take over a newer take once its first frame is there, and what was added to it since."""
        take = self.preview.shown
        if take is None:
            return
        if take is not self.take:
            self.take, self.source = take, LIVE
            self.timeline.resize(len(take.frames), take.interval)
            self.timeline.seek(1, time.monotonic())
            self.timeline.play(time.monotonic())
        if self.source == LIVE:
            self.timeline.growing = not take.complete and not take.broken and self.preview.busy
            if self.timeline.count != len(take.frames):
                self.timeline.resize(len(take.frames))

    def _draw(self, index: int) -> None:
        live = self.source == LIVE and self.take is not None
        take = self.take
        problem = ""
        frame: SplatFrame | None = None
        if live and take is not None:
            frame = take.frames[min(index, len(take.frames) - 1)]
        elif self.saved.count:
            try:
                frame = self.cache.get(index)
            except FrameMissing as error:
                problem = f"{error} The frame before it stays in view."
        spacing = take.spacing if live and take is not None else self.saved.spacing
        if frame is not None:
            self.stage.ground(take.ground if live and take is not None else None)
            said = self.stage.show(frame, self.parts, spacing, colored(frame.rgb, self.draft.look))
            problem, self.fastest = problem or said, frame.fastest if self.parts.arrows else 0.0
        poses = frame.poses if frame is not None else None
        # at the first frame obstacles stand where they are put, also while somebody drags them
        self.stage.obstacles(self.bodies(), poses if index else None, self.parts, self.chosen)
        if problem:
            self.messages = problem
        self.panels.show_picture(index)

    def bodies(self) -> tuple[Any, ...]:
        """Obstacles of the scene as it is now."""
        listed = self.draft.obstacles
        if listed != self._bodies_of:
            try:
                self._bodies, self._bodies_of = obstacles_of(self.folder, {"obstacles": listed}), listed
            except FluidliftError as error:
                self._bodies_of = listed
                self.messages = str(error)
        return self._bodies

    def _read(self, index: int) -> SplatFrame:
        return replace(read_frame(self.folder, index, cell=self.saved.spacing), poses=self.saved.poses(index))

    # around it

    def _watch(self) -> None:
        """Notice what other processes do to the asset."""
        before = self.saved.foreign
        if self.saved.scene_changed():
            self.draft.forget()
            self.panels.refresh()
        if self.saved.look(ours=self.jobs.running):
            self.cache.clear()
            with self.lock:
                if self.source == SAVED:
                    self.timeline.resize(self.saved.count, self.saved.interval)
            self._dirty = True
        if self.saved.foreign != before:
            self.say("Another process is writing this asset: frames may be missing until it is done."
                     if self.saved.foreign else "The other process is done; its frames are shown.")  # fmt: skip

    def _preview_told(self) -> None:
        self._dirty = True

    def _job_ended(self) -> None:
        self.saved.reload()
        self.cache.clear()
        self.preview.hold(False)
        self.draft.forget()
        self.panels.job_ended()
        self._dirty = True

    def surprised(self, doing: str, error: Exception, *, trace: bool = True) -> None:
        """Tell an error that a thread meets: in words where it is one of ours, else also with its trace in the log."""
        if isinstance(error, (FluidliftError, OSError)):
            self.say(f"{doing}: {error}")
            return
        self.say(f"{doing}: unexpected {type(error).__name__}: {error}")
        if trace:
            LOG.error("%s", doing, exc_info=error)

    def compare(self) -> None:
        """The scene or the frames have changed: find out whether they still belong together."""
        self.comparison.again()

    def _find_pictures(self) -> None:
        try:
            self.pictures = input_pictures(self.folder, self.saved.manifest, self.asset.camera, self.saved.interval)
        except (FluidliftError, OSError, ValueError):
            pass  # the panel says that there are none
        except Exception as error:
            self.surprised("looking for the input video", error)
        finally:
            self.looking_for_pictures, self._dirty = False, True

    def close(self) -> None:
        """Stop everything; what was edited stays in the history."""
        if not self.alive:
            return
        self.alive = False
        self.jobs.stop()
        self.preview.close()
        self._thread.join(timeout=5.0)
        with contextlib.suppress(FluidliftError, OSError):
            self.draft.commit()
        self.jobs.wait(10.0)
        self.server.stop()


def _kept(frame: PreviewFrame) -> SplatFrame:
    return splat_frame(frame.gaussians, frame.velocities, frame.poses, cell=frame.cell)


__all__ = ["InputRejected", "ViewRequest", "Viewer", "view_asset"]
