"""What lies is told from what stands by what the whole sight of a fluid says: kind, parts and tilt together."""

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.pipeline import sight
from fluidlift.pipeline.settings import GeometrySettings, GivenView, taken
from fluidlift.shape.jets import find_neck
from fluidlift.shape.view import drawn_rim
from fluidlift.types import KindEvidence, PinholeCamera, VideoClip
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.kind import KINDS, POUR, STREAM

H, W, T = 160, 200, 6
ROW, COL = np.mgrid[:H, :W] + 0.5
FOOT = np.array([100.0, 52.0])
"""of the jet"""


def tray(slows):
    """Honey of an even depth that runs from a jet into a round pool, and what is seen of it; `slows`: as 1 / r."""
    pool = ((ROW - 95.0) / 50.0) ** 2 + ((COL - 100.0) / 80.0) ** 2 < 1
    jet = (np.abs(COL - FOOT[0]) < 8) & (ROW > 25) & (ROW < 60)
    away = np.stack([COL, ROW], axis=-1) - FOOT
    r = np.maximum(np.linalg.norm(away, axis=-1), 12.0)
    fan = pool & (np.abs(away[..., 0]) < 0.4 * away[..., 1])
    motion = np.where(fan, 4.0 * (12.0 / r) ** slows, 0.0)[..., None] * away / r[..., None]
    mask = pool | jet
    frames = np.full((T, H, W, 3), 90, np.uint8)
    frames[:, mask] = (190, 130, 60)
    clip = VideoClip(frames, np.arange(T) / 30.0, "made")
    fluid = FluidMasks(np.repeat(mask[None], T, axis=0).astype(np.uint8))
    trust = np.where(mask, 0.8, 0.0)
    return sight._Looked(clip, fluid, mask, motion, trust, None, np.arange(T), frames[0], ())


def found(looked):
    known = PinholeCamera.from_fov(50.0, (W, H))
    config = taken(GeometrySettings, build_config().shape, drawn=None)
    return sight._kind_and_up(looked, GivenView(None), config, known, False, shaped=False)


def test_a_pool_in_which_a_jet_spreads_is_level_and_closed():
    _, kind, parts, up, *_ = found(tray(slows=1.0))
    assert kind.name == "stream" and parts.puddle and len(parts.outlines) == 1
    assert parts.falling[30:45, 100].all() and not parts.falling[75:].any(), "what spreads is no jet, fast as it is"
    # a level circle is as flat as the sine of the tilt; the habit of such views pulls at it
    assert up.pitch == pytest.approx(np.degrees(np.arcsin(50.0 / 80.0)), abs=5.0)


def test_what_keeps_its_speed_in_a_round_outline_may_run_down_a_slope():
    _, _, parts, *_ = found(tray(slows=0.0))
    assert not parts.puddle


def poured(monkeypatch, body, rims=()):
    """Kind and parts of a jet that falls into a body of still water, whose look says that it is a pour."""
    mask = body | (np.abs(COL - 100.0) < 6) & (ROW < 100)
    frames = np.full((T, H, W, 3), 90, np.uint8)
    clip = VideoClip(frames, np.arange(T) / 30.0, "made")
    fluid = FluidMasks(np.repeat(mask[None], T, axis=0).astype(np.uint8))
    still = np.zeros((H, W, 2))
    looked = sight._Looked(clip, fluid, mask, still, np.zeros((H, W)), None, np.arange(T), frames[0], rims)
    evidence = KindEvidence(POUR.name, {name: float(name == POUR.name) for name in KINDS}, {})
    monkeypatch.setattr(sight.kinds, "estimate_kind", lambda *_, **__: evidence)
    _, kind, parts, *_ = found(looked)
    return kind, parts


def test_a_jet_into_a_puddle_is_a_stream_and_one_into_a_vessel_stays_a_pour(monkeypatch):
    pool = ((ROW - 100.0) / 32.0) ** 2 + ((COL - 100.0) / 50.0) ** 2 < 1
    kind, parts = poured(monkeypatch, pool)
    assert kind == STREAM and parts.puddle and len(parts.outlines) == 1
    kind, parts = poured(monkeypatch, pool, (drawn_rim((100.0, 90.0), (68.0, 46.0), 0.0),))
    assert kind == POUR and not parts.puddle and not parts.outlines
    glass = (np.abs(COL - 100.0) < 42.0) & (ROW > 78) & (ROW < 150)  # wider than tall, and no ellipse
    assert find_neck(glass | (np.abs(COL - 100.0) < 6) & (ROW < 100)) is not None
    kind, parts = poured(monkeypatch, glass)
    assert kind == POUR and not parts.puddle and not parts.outlines
