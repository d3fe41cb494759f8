"""The user's own optical flow in place of the estimated one.

It belongs to the frames of the clip's file: `--start`, `--duration`, cuts and left-out frames select from it. Flow that
was made for the frames that are used alone (as `fluidlift motion` writes it) is taken as well, and said so.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.video import frames_before
from fluidlift.messages import Notice
from fluidlift.pipeline.settings import GivenFlow
from fluidlift.types.stages import Read

if TYPE_CHECKING:
    from fluidlift.io.flow_files import FlowFiles, FlowLayout, Pair


def flow_of_files(read: Read, given: GivenFlow) -> tuple[Iterable[Pair], bool, list[Notice]]:
    """The user's displacement and confidence of each pair of the used frames, whether the files have one, warnings.

    Raises:
        InputRejected: a flow of another shape, or too few pairs, with the first frame that lacks one.
    """
    from fluidlift.io.images import read_distortion

    files, places, warnings = _opened(read, given)
    warnings += files.warnings
    if read.stabilised:
        warnings.append(
            Notice(
                "flow-not-steadied",
                "the clip was steadied, the given flow was not: it should be that of steady pictures",
            )
        )
    if given.camera is not None and read_distortion(given.camera.path) is not None:
        warnings.append(
            Notice(
                "flow-lens-distorted",
                "lens distortion was taken out of the clip: the given flow should be that of such pictures",
            )
        )

    return (_between(files, first, last) for first, last in pairwise(places.tolist())), files.has_confidence, warnings


def _opened(read: Read, given: GivenFlow) -> tuple[FlowFiles, np.ndarray, list[Notice]]:
    """The files, and the pair of theirs that begins at each used frame."""
    from fluidlift.io.flow_files import open_flow

    size, decoded, kept = read.clip.size, read.decoded, np.asarray(read.kept)
    before = frames_before(given.clip.path, given.start, given.fps) if given.start > 0 else 0
    used, layout = np.arange(len(kept)), flow_layout(given)
    ways = [(before, decoded - 1, kept, "")]
    if before:
        ways.append((0, decoded - 1, kept, f"it is taken to begin where --start does, with frame {before} of the file"))
    if decoded > len(kept):
        ways.append((0, len(kept) - 1, used, "it is taken to be that of the frames that are used alone"))
    refusal: InputRejected | None = None
    for start, pairs, places, words in ways:
        try:
            files = open_flow(given.files.path, size, pairs, start=start, layout=layout)
        except InputRejected as error:
            refusal = refusal or error
            continue
        return (
            files,
            places,
            [Notice("flow-shorter-than-clip", f"the given flow is shorter than the clip's file: {words}")]
            if words
            else [],
        )
    assert refusal is not None
    raise refusal


def flow_layout(given: GivenFlow) -> FlowLayout:
    """What the numbers of the user's flow mean, from the settings.

    Raises:
        InputRejected: other than two channels, or a scale of 0.
    """
    from fluidlift.io.flow_files import FlowLayout

    channels = given.flow_channels
    if len(channels) not in (0, 2):
        raise InputRejected(f"motion.flow_channels = {','.join(channels)}", "two names, such as R,G")
    if given.flow_scale == 0:
        raise InputRejected("motion.flow_scale = 0", "px per stored unit, not 0")
    return FlowLayout((channels[0], channels[1]) if channels else None, given.flow_v_up, given.flow_scale)


def _between(files: FlowFiles, first: int, last: int) -> Pair:
    """Displacement and confidence from one used frame to the next; frames between that were left out stood still."""
    displacement, confidence = files.pair(first)
    for k in range(first + 1, last):
        more, sure = files.pair(k)
        displacement, confidence = displacement + more, np.minimum(confidence, sure)
    return displacement, confidence
