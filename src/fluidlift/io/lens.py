"""The lens that a video's metadata names."""

from __future__ import annotations

import math
import re
from pathlib import Path

from fluidlift.io.decode import open_video
from fluidlift.io.limits import ReadLimits
from fluidlift.io.sequences import is_sequence

FULL_FRAME = 36.0
"""mm along the longer side of the film that "35 mm equivalent" refers to"""

_KEY = re.compile(r"focal.?length.*35", re.IGNORECASE)
"""com.apple.quicktime.camera.focal_length.35mm_equivalent, FocalLengthIn35mmFilm and their like"""


def lens_field_of_view(path: Path | str, limits: ReadLimits | None = None) -> float | None:
    """Field of view across the longer side, degrees, from a 35 mm equivalent focal length in the file's metadata.

    None where there is none, or where it makes no sense (below 5 mm or above 1000 mm). Image sequences say nothing.

    Raises:
        InputRejected: as `read_clip`, for a file that is not a video.
    """
    if is_sequence(path):
        return None
    with open_video(Path(path), limits or ReadLimits()) as (container, stream):
        entries = {**container.metadata, **stream.metadata}
    for key, text in entries.items():
        number = re.search(r"\d+(\.\d+)?", str(text)) if _KEY.search(key) else None
        if number and 5.0 <= float(number[0]) <= 1000.0:
            return math.degrees(2.0 * math.atan(FULL_FRAME / (2.0 * float(number[0]))))
    return None
