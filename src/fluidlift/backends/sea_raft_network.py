"""The network of SEA-RAFT (Wang, Lipson, Deng 2024): the names of its parts are those of the authors' checkpoints.

Written after the paper and the structure of the reference implementation (BSD-3, princeton-vl/SEA-RAFT): a truncated
ResNet looks at both pictures together and guesses a first flow; another one gives features whose correlation over a
pyramid refines it, a fixed number of times. Each estimate is a mixture of two Laplace distributions per pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fluidlift.backends.pair_network import STRIDE
from fluidlift.errors import InputRejected, require

LEVELS = 4
"""of the correlation pyramid"""
WIDEST = 10.0
"""largest logarithm of the wide component's scale that the authors train with (`var_max`); the narrow one's is 0"""
_BLOCKS = {"resnet18": (2, 2, 2), "resnet34": (3, 4, 6)}


@dataclass(frozen=True)
class SeaRaftShape:
    """What differs between the published variants."""

    blocks: tuple[int, int, int] = (3, 4, 6)
    """residual blocks of the three stages: (3, 4, 6) is a ResNet-34 (M, L), (2, 2, 2) a ResNet-18 (S)"""
    stem: int = 64
    """channels after the first convolution"""
    stages: tuple[int, int, int] = (64, 128, 256)
    """channels of the three stages"""
    width: int = 128
    """channels of the hidden state, and of the context"""
    radius: int = 4
    """cells to each side in which correlations are looked up"""
    refiners: int = 2
    """ConvNeXt blocks per iteration"""

    @classmethod
    def of(cls, state: Mapping[str, Tensor], name: str) -> SeaRaftShape:
        """The shape that a checkpoint was made for.

        Raises:
            InputRejected: these are no weights of SEA-RAFT.
        """
        try:
            one, two, three = (_count(state, f"fnet.layer{i}.") for i in (1, 2, 3))
            low, middle, high = (len(state[f"fnet.layer{i}.0.conv1.weight"]) for i in (1, 2, 3))
            window = state["update_block.encoder.convc1.weight"].shape[1] / LEVELS
            radius = round((window**0.5 - 1) / 2)
            shape = cls(
                blocks=(one, two, three),
                stem=len(state["fnet.conv1.weight"]),
                stages=(low, middle, high),
                width=state["flow_head.0.weight"].shape[1],
                radius=radius,
                refiners=_count(state, "update_block.refine."),
            )
        except (KeyError, IndexError) as error:
            raise InputRejected(
                f"'{name}' holds no weights of SEA-RAFT ({error} lacks)", "a checkpoint of its authors: S, M or L"
            ) from None
        if (2 * radius + 1) ** 2 != window or shape.blocks not in _BLOCKS.values() or not shape.refiners:
            raise InputRejected(f"'{name}' holds a variant of SEA-RAFT that is not known ({shape})", "S, M or L")
        return shape


def _count(state: Mapping[str, Tensor], prefix: str) -> int:
    return len({name[len(prefix) :].split(".")[0] for name in state if name.startswith(prefix)})


def completed_state(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """With both names of layers that have two: a .safetensors file stores a shared tensor once."""
    out = dict(state)
    for name, tensor in state.items():
        for one, other in ((".bn3.", ".downsample.1."), (".downsample.1.", ".bn3.")):
            if one in name:
                out.setdefault(name.replace(one, other), tensor)
    return out


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions and a way round them."""

    def __init__(self, inside: int, outside: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inside, outside, 3, stride, padding=1)
        self.conv2 = nn.Conv2d(outside, outside, 3, padding=1)
        self.bn1, self.bn2 = nn.BatchNorm2d(outside), nn.BatchNorm2d(outside)
        self.downsample = None
        if stride != 1 or inside != outside:
            self.bn3 = nn.BatchNorm2d(outside)  # the checkpoints know it by this name too
            self.downsample = nn.Sequential(nn.Conv2d(inside, outside, 1, stride), self.bn3)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class Encoder(nn.Module):
    """The first three stages of a ResNet, down to an eighth of the picture."""

    def __init__(self, channels: int, out: int, shape: SeaRaftShape) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, shape.stem, 7, 2, padding=3)
        self.bn1 = nn.BatchNorm2d(shape.stem)
        before = (shape.stem, *shape.stages[:2])
        self.layer1, self.layer2, self.layer3 = (
            nn.Sequential(
                *(ResidualBlock(a if k == 0 else b, b, stride if k == 0 else 1) for k in range(shape.blocks[i]))
            )
            for i, (a, b, stride) in enumerate(zip(before, shape.stages, (1, 2, 2)))
        )
        self.final_conv = nn.Conv2d(shape.stages[2], out, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.bn1(self.conv1(x)))
        return self.final_conv(self.layer3(self.layer2(self.layer1(x))))


class MotionEncoder(nn.Module):
    """Correlations and the flow so far as features."""

    def __init__(self, correlations: int, width: int) -> None:
        super().__init__()
        self.convc1 = nn.Conv2d(correlations, 2 * width, 1)
        self.convc2 = nn.Conv2d(2 * width, width + width // 2, 3, padding=1)
        self.convf1 = nn.Conv2d(2, width, 7, padding=3)
        self.convf2 = nn.Conv2d(width, width // 2, 3, padding=1)
        self.conv = nn.Conv2d(2 * width, width - 2, 3, padding=1)

    def forward(self, flow: Tensor, correlations: Tensor) -> Tensor:
        seen = F.relu(self.convc2(F.relu(self.convc1(correlations))))
        moved = F.relu(self.convf2(F.relu(self.convf1(flow))))
        return torch.cat([F.relu(self.conv(torch.cat([seen, moved], dim=1))), flow], dim=1)


class Refiner(nn.Module):
    """A ConvNeXt block (Liu et al. 2022) that ends with fewer channels than it began with."""

    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.dwconv = nn.Conv2d(inside, inside, 7, padding=3, groups=inside)
        self.norm = nn.LayerNorm(inside, eps=1e-6)
        self.pwconv1 = nn.Linear(inside, 4 * outside)
        self.pwconv2 = nn.Linear(4 * outside, inside)
        self.gamma = nn.Parameter(torch.full((inside,), 1e-6))
        self.final = nn.Conv2d(inside, outside, 1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm(self.dwconv(x).permute(0, 2, 3, 1))
        y = self.gamma * self.pwconv2(F.gelu(self.pwconv1(y)))
        return self.final(x + y.permute(0, 3, 1, 2))


class UpdateBlock(nn.Module):
    """One iteration of the hidden state."""

    def __init__(self, shape: SeaRaftShape) -> None:
        super().__init__()
        self.encoder = MotionEncoder(LEVELS * (2 * shape.radius + 1) ** 2, shape.width)
        self.refine = nn.ModuleList(Refiner(3 * shape.width, shape.width) for _ in range(shape.refiners))

    def forward(self, hidden: Tensor, context: Tensor, correlations: Tensor, flow: Tensor) -> Tensor:
        beside = torch.cat([context, self.encoder(flow, correlations)], dim=1)
        for block in self.refine:
            hidden = block(torch.cat([hidden, beside], dim=1))
        return hidden


class CorrelationPyramid:
    """Scalar products of every cell of one picture with every cell of the other, the latter at four resolutions."""

    def __init__(self, first: Tensor, second: Tensor, radius: int) -> None:
        channels, self._rows, self._columns = first.shape[1:]
        self._radius, self._levels = radius, []
        query = first.flatten(2).transpose(1, 2) / channels**0.5
        for _ in range(LEVELS):
            products = query @ second.flatten(2)
            self._levels.append(products.reshape(-1, 1, *second.shape[2:]))
            second = F.interpolate(second, scale_factor=0.5, mode="bilinear", align_corners=False)

    def around(self, target: Tensor) -> Tensor:
        """[B,LEVELS*(2r+1)^2,h,w]: what lies round `target` [B,2,h,w] (column, row, in cells) on each level."""
        batch, side = len(target), 2 * self._radius + 1
        reach = torch.arange(-self._radius, self._radius + 1, device=target.device, dtype=target.dtype)
        window = torch.stack(torch.meshgrid(reach, reach, indexing="ij"), dim=-1)  # columns vary slowest: as trained
        centre = target.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2)
        found = []
        for level, products in enumerate(self._levels):
            extent = torch.tensor([products.shape[3] - 1, products.shape[2] - 1], device=target.device)
            at = 2.0 * (centre / 2**level + window) / extent - 1.0
            values = F.grid_sample(products, at, align_corners=True)
            found.append(values.reshape(batch, self._rows, self._columns, side * side))
        return torch.cat(found, dim=-1).permute(0, 3, 1, 2)


class SeaRaftNetwork(nn.Module):
    """Flow between two pictures with the mixture that says how sure it is."""

    def __init__(self, shape: SeaRaftShape) -> None:
        super().__init__()
        self.shape, width = shape, shape.width
        self.cnet = Encoder(6, 2 * width, shape)
        self.fnet = Encoder(3, 2 * width, shape)
        self.init_conv = nn.Conv2d(2 * width, 2 * width, 3, padding=1)
        self.upsample_weight = nn.Sequential(
            nn.Conv2d(width, 2 * width, 3, padding=1), nn.ReLU(), nn.Conv2d(2 * width, 9 * STRIDE**2, 1)
        )
        self.flow_head = nn.Sequential(
            nn.Conv2d(width, 2 * width, 3, padding=1), nn.ReLU(), nn.Conv2d(2 * width, 6, 3, padding=1)
        )
        self.update_block = UpdateBlock(shape)

    def forward(self, first: Tensor, second: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
        """Flow [B,2,H,W] (px) and raw mixture [B,4,H,W] (two weights before softmax, two logarithms of scales).

        Args:
            first: [B,3,H,W] from -1 to 1; H and W are multiples of `STRIDE`.
            second: the same.
            iterations: refinements; the authors use 4 (S, M) and 12 (L).
        """
        require(
            first.shape[2] % STRIDE == 0 == first.shape[3] % STRIDE, f"pictures {tuple(first.shape)}", "padded ones"
        )
        both = self.init_conv(self.cnet(torch.cat([first, second], dim=1)))
        hidden, context = both.split(self.shape.width, dim=1)
        flow, mixture = self.flow_head(hidden).split([2, 4], dim=1)
        pyramid = CorrelationPyramid(self.fnet(first), self.fnet(second), self.shape.radius) if iterations else None
        rows, columns = (torch.arange(n, device=flow.device, dtype=flow.dtype) for n in flow.shape[2:])
        here = torch.stack(torch.meshgrid(columns, rows, indexing="xy"))[None]
        for _ in range(iterations):
            assert pyramid is not None
            hidden = self.update_block(hidden, context, pyramid.around(here + flow), flow)
            step, mixture = self.flow_head(hidden).split([2, 4], dim=1)
            flow = flow + step
        blend = 0.25 * self.upsample_weight(hidden)
        return upsampled(STRIDE * flow, blend), upsampled(mixture, blend)


def upsampled(values: Tensor, blend: Tensor) -> Tensor:
    """[B,C,h,w] at eight times the resolution: each pixel is a convex mean of the 3x3 cells round it.

    Args:
        values: per cell.
        blend: [B,9*64,h,w], logits of the nine weights of each of the 64 pixels of a cell.
    """
    batch, channels, rows, columns = values.shape
    cells = F.unfold(values, 3, padding=1).reshape(batch, channels, 9, 1, rows, columns)
    weights = blend.reshape(batch, 1, 9, STRIDE**2, rows, columns).softmax(dim=2)
    pixels = (cells * weights).sum(dim=2)  # [B,C,64,h,w]
    return F.pixel_shuffle(pixels.reshape(batch, -1, rows, columns), STRIDE)


def mixture_confidence(mixture: Tensor) -> Tensor:
    """[B,H,W] from 0 to 1: the predicted density of an error of zero, over that of the narrow component alone.

    The error of each component of the flow is taken to follow w1 Laplace(b1) + w2 Laplace(b2) with b2 = 1 px and
    b1 = exp(s), s from 0 to `WIDEST`. Density at zero is the sum of w / (2 b).
    """
    weights = mixture[:, :2].softmax(dim=1)
    return weights[:, 1] + weights[:, 0] * torch.exp(-mixture[:, 2].clamp(0.0, WIDEST))
