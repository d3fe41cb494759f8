"""The network of GeoCalib (Veicht et al. 2024): the names of its parts are those of the authors' checkpoint.

Written after the paper and the structure of the reference implementation (Apache-2.0, cvg/GeoCalib): an MSCAN encoder
(SegNeXt: Guo et al. 2022) looks at the picture at a quarter to a thirty-second of its size, and two light Hamburger
decoders (Geng et al. 2021) make a perspective field of it: in which direction of the picture "up" lies at each pixel,
how far its ray rises above the horizon, and how sure both are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fluidlift.errors import InputRejected, require

STRIDE = 32
"""px, of which both sides of a picture are a multiple"""
RANK, ROUNDS = 64, 7
"""bases of the matrix factorisation in a decoder, and its rounds: the authors' for inference"""
SEED = 0
"""of the bases that the factorisation begins with; the authors draw them anew each time"""


@dataclass(frozen=True)
class GeoCalibShape:
    """Channels and blocks; the defaults are those of the published checkpoint."""

    stages: tuple[int, ...] = (64, 128, 320, 512)
    """channels of the encoder's four stages"""
    blocks: tuple[int, ...] = (3, 3, 12, 3)
    inner: tuple[int, ...] = (512, 1024, 1280, 2048)
    """channels within the perceptrons of each stage"""
    low: int = 64
    """channels of the features of the whole picture, and of what a decoder gives"""
    ham: int = 512
    """channels that a decoder factorises"""

    @classmethod
    def of(cls, state: Mapping[str, Tensor], name: str) -> GeoCalibShape:
        """The shape that a checkpoint was made for.

        Raises:
            InputRejected: these are no weights of GeoCalib.
        """
        levels = range(1, 5)
        try:
            shape = cls(
                tuple(len(state[f"backbone.norm{i}.weight"]) for i in levels),
                tuple(_count(state, f"backbone.block{i}.") for i in levels),
                tuple(len(state[f"backbone.block{i}.0.mlp.fc1.weight"]) for i in levels),
                len(state["ll_enc.conv1.conv.weight"]),
                len(state["perspective_decoder.up_head.decoder.squeeze.conv.weight"]),
            )
        except (KeyError, TypeError) as error:
            raise InputRejected(
                f"'{name}' holds no weights of GeoCalib ({error} lacks)", "geocalib-pinhole.tar of its authors"
            ) from None
        largest = cls()
        sizes = zip(
            (*shape.stages, *shape.blocks, *shape.inner, shape.low, shape.ham),
            (*largest.stages, *largest.blocks, *largest.inner, largest.low, largest.ham),
            strict=True,
        )
        if any(not 1 <= ours <= most for ours, most in sizes) or shape.stages[0] % 2:
            raise InputRejected(f"'{name}' holds a variant of GeoCalib that is not known ({shape})", "the authors' own")
        return shape


def _count(state: Mapping[str, Tensor], prefix: str) -> int:
    return len({name[len(prefix) :].split(".")[0] for name in state if name.startswith(prefix)})


def completed_state(state: Mapping[str, Tensor], network: nn.Module) -> dict[str, Tensor]:
    """With the counters of training batches, which nothing reads, where a file leaves them out."""
    counters = {k: v for k, v in network.state_dict().items() if k.endswith("num_batches_tracked")}
    return counters | dict(state)


class Convolution(nn.Module):
    """A convolution and a rectifier."""

    def __init__(self, inside: int, outside: int, size: int, *, bias: bool = True) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inside, outside, size, padding=size // 2, bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.conv(x))


class Strips(nn.Module):
    """Attention by convolutions over strips of 7, 11 and 21 px, which multiplies what comes in."""

    def __init__(self, width: int) -> None:
        super().__init__()

        def alone(rows: int, columns: int) -> nn.Conv2d:
            return nn.Conv2d(width, width, (rows, columns), padding=(rows // 2, columns // 2), groups=width)

        self.conv0 = alone(5, 5)
        self.conv0_1, self.conv0_2 = alone(1, 7), alone(7, 1)
        self.conv1_1, self.conv1_2 = alone(1, 11), alone(11, 1)
        self.conv2_1, self.conv2_2 = alone(1, 21), alone(21, 1)
        self.conv3 = nn.Conv2d(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        near = self.conv0(x)
        far = [self.conv0_2(self.conv0_1(near)), self.conv1_2(self.conv1_1(near)), self.conv2_2(self.conv2_1(near))]
        return self.conv3(near + far[0] + far[1] + far[2]) * x


class Attention(nn.Module):
    """Strips between two projections, and a way round them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.proj_1 = nn.Conv2d(width, width, 1)
        self.spatial_gating_unit = Strips(width)
        self.proj_2 = nn.Conv2d(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.proj_2(self.spatial_gating_unit(F.gelu(self.proj_1(x)))) + x


class Alone(nn.Module):
    """A convolution of each channel for itself."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.dwconv = nn.Conv2d(width, width, 3, padding=1, groups=width)

    def forward(self, x: Tensor) -> Tensor:
        return self.dwconv(x)


class Perceptron(nn.Module):
    """Two projections with a convolution of each channel between them."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.fc1 = nn.Conv2d(width, inner, 1)
        self.dwconv = Alone(inner)
        self.fc2 = nn.Conv2d(inner, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.dwconv(self.fc1(x))))


class Block(nn.Module):
    """Attention, then a perceptron, each scaled by channel and added."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.BatchNorm2d(width), nn.BatchNorm2d(width)
        self.attn = Attention(width)
        self.mlp = Perceptron(width, inner)
        self.layer_scale_1 = nn.Parameter(torch.full((width,), 1e-2))
        self.layer_scale_2 = nn.Parameter(torch.full((width,), 1e-2))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.layer_scale_1[:, None, None] * self.attn(self.norm1(x))
        return x + self.layer_scale_2[:, None, None] * self.mlp(self.norm2(x))


class Halving(nn.Module):
    """From one stage to the next, at half of the size."""

    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(inside, outside, 3, 2, padding=1)
        self.norm = nn.BatchNorm2d(outside)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.proj(x))


class Stem(nn.Module):
    """From the picture to the first stage, at a quarter of its size."""

    def __init__(self, outside: int) -> None:
        super().__init__()
        half = outside // 2
        self.proj = nn.Sequential(
            nn.Conv2d(3, half, 3, 2, padding=1), nn.BatchNorm2d(half), nn.GELU(),
            nn.Conv2d(half, outside, 3, 2, padding=1), nn.BatchNorm2d(outside),
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        return self.proj(x)


class Backbone(nn.Module):
    """MSCAN: four stages of blocks, each at half of the size of the one before."""

    def __init__(self, shape: GeoCalibShape) -> None:
        super().__init__()
        for i, width in enumerate(shape.stages):
            entry = Stem(width) if i == 0 else Halving(shape.stages[i - 1], width)
            self.add_module(f"patch_embed{i + 1}", entry)
            self.add_module(
                f"block{i + 1}", nn.ModuleList(Block(width, shape.inner[i]) for _ in range(shape.blocks[i]))
            )
            self.add_module(f"norm{i + 1}", nn.LayerNorm(width))
        self._stages = len(shape.stages)

    def forward(self, image: Tensor) -> list[Tensor]:
        x, found = image[:, [2, 1, 0]] * 255.0, []  # it was trained first with BGR from 0 to 255
        for i in range(1, self._stages + 1):
            x = self.get_submodule(f"patch_embed{i}")(x)
            for block in self.get_submodule(f"block{i}").children():
                x = block(x)
            x = self.get_submodule(f"norm{i}")(x.movedim(1, -1)).movedim(-1, 1).contiguous()
            found.append(x)
        return found


class LowLevel(nn.Module):
    """Two convolutions of the whole picture."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = Convolution(3, width, 3), Convolution(width, width, 3)

    def forward(self, image: Tensor) -> Tensor:
        return self.conv2(self.conv1(image))


class Hamburger(nn.Module):
    """What is left of the features by a few non-negative bases, added to them (Geng et al. 2021)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.ham_in, self.ham_out = Convolution(width, width, 1), Convolution(width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.ham_out(factorised(self.ham_in(x))))


def factorised(x: Tensor) -> Tensor:
    """Non-negative features [b,c,h,w] as a product of `RANK` bases and their shares, by multiplicative updates."""
    b, c, h, w = x.shape
    values = x.reshape(b, c, h * w)
    drawn = torch.rand((b, c, RANK), generator=torch.Generator().manual_seed(SEED)).to(values)
    bases = F.normalize(drawn, dim=1)
    shares = F.softmax(values.transpose(1, 2) @ bases, dim=-1)
    for _ in range(ROUNDS):
        shares = _shared(values, bases, shares)
        bases = bases * (values @ shares) / (bases @ (shares.transpose(1, 2) @ shares) + 1e-6)
    shares = _shared(values, bases, shares)
    return (bases @ shares.transpose(1, 2)).reshape(b, c, h, w)


def _shared(values: Tensor, bases: Tensor, shares: Tensor) -> Tensor:
    return shares * (values.transpose(1, 2) @ bases) / (shares @ (bases.transpose(1, 2) @ bases) + 1e-6)


class Residual(nn.Module):
    """Two convolutions and a way round them; what goes round is rectified as well, as in the reference."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(width, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(x)
        return self.conv2(F.relu(self.conv1(x))) + x


class Fusion(nn.Module):
    """Features of the stages with those of the whole picture."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.resConfUnit1, self.resConfUnit2 = Residual(width), Residual(width)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        return self.resConfUnit2(coarse + self.resConfUnit1(fine))


class Decoder(nn.Module):
    """Features of the picture's size, and the logarithm of the odds that what is made of them is right."""

    def __init__(self, shape: GeoCalibShape) -> None:
        super().__init__()
        low, ham = shape.low, shape.ham
        self.squeeze = Convolution(sum(shape.stages), ham, 1)
        self.hamburger = Hamburger(ham)
        self.align = Convolution(ham, low, 1)
        self.linear_pred_uncertainty = nn.Sequential(Convolution(low, low, 3, bias=False), nn.Conv2d(low, 1, 1))
        self.out_conv = Convolution(low, low, 3, bias=False)
        self.ll_fusion = Fusion(low)

    def forward(self, stages: list[Tensor], low: Tensor) -> tuple[Tensor, Tensor]:
        size = stages[0].shape[2:]
        together = torch.cat([F.interpolate(s, size, mode="bilinear", align_corners=False) for s in stages], dim=1)
        x = self.align(self.hamburger(self.squeeze(together)))
        x = self.out_conv(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False))
        x = self.ll_fusion(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False), low)
        return x, self.linear_pred_uncertainty(x)[:, 0]


class UpHead(nn.Module):
    """The direction of up in the picture."""

    def __init__(self, shape: GeoCalibShape) -> None:
        super().__init__()
        self.decoder = Decoder(shape)
        self.linear_pred_up = nn.Conv2d(shape.low, 2, 1)

    def forward(self, stages: list[Tensor], low: Tensor) -> tuple[Tensor, Tensor]:
        x, odds = self.decoder(stages, low)
        return F.normalize(self.linear_pred_up(x), dim=1), torch.sigmoid(odds)


class LatitudeHead(nn.Module):
    """The sine of the angle between each ray and the level."""

    def __init__(self, shape: GeoCalibShape) -> None:
        super().__init__()
        self.decoder = Decoder(shape)
        self.linear_pred_latitude = nn.Conv2d(shape.low, 1, 1)

    def forward(self, stages: list[Tensor], low: Tensor) -> tuple[Tensor, Tensor]:
        x, odds = self.decoder(stages, low)
        return torch.tanh(self.linear_pred_latitude(x))[:, 0], torch.sigmoid(odds)


class PerspectiveDecoder(nn.Module):
    """Both heads."""

    def __init__(self, shape: GeoCalibShape) -> None:
        super().__init__()
        self.up_head, self.latitude_head = UpHead(shape), LatitudeHead(shape)


class GeoCalibNetwork(nn.Module):
    """Picture to perspective field.

    Args:
        shape: of the network.
    """

    def __init__(self, shape: GeoCalibShape | None = None) -> None:
        super().__init__()
        shape = shape or GeoCalibShape()
        self.backbone = Backbone(shape)
        self.ll_enc = LowLevel(shape.low)
        self.perspective_decoder = PerspectiveDecoder(shape)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Up [b,2,h,w], trust in it [b,h,w], sine of the latitude [b,h,w], and trust in that [b,h,w].

        Args:
            image: float [b,3,h,w], sRGB from 0 to 1; h and w are multiples of `STRIDE`.

        Raises:
            ValueError: another size.
        """
        h, w = image.shape[-2:]
        require(
            h % STRIDE == 0 and w % STRIDE == 0 and h * w > 0, f"a picture of {w} x {h} px", f"multiples of {STRIDE}"
        )
        stages, low = self.backbone(image), self.ll_enc(image)
        return (*self.perspective_decoder.up_head(stages, low), *self.perspective_decoder.latitude_head(stages, low))
