"""The field of the VolSDF paper: an 8 x 256 MLP with positional encoding, initialised to a sphere (appendix B)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.field.grid_field import Background, Field

SHARPNESS = 100.0  # of the Softplus
SPAN = 3.0  # the networks see the unit sphere with the paper's radius of 3, for which Softplus and waves are made


@dataclass(frozen=True)
class MlpSize:
    """Size of the paper's two networks."""

    depth: int = 8  # hidden layers of the SDF network; the position enters again at the middle one
    width: int = 256  # of its layers, and of its output features
    frequencies: int = 6  # octaves of the positional encoding of positions
    color_depth: int = 4  # hidden layers of the colour network
    view_frequencies: int = 4  # octaves of the encoding of directions
    background: int = 64  # grid points a side of the finest level of the background

    @property
    def finest(self) -> float:
        """Half a wave of the highest octave, normalised units, the limit of resolution."""
        return math.pi / (SPAN * 2.0 ** (self.frequencies - 1))

    @property
    def sampling(self) -> float:
        """Distance of samples that show all detail, normalised units: two to half a wave."""
        return self.finest / 2


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """Values [P, 3] with their sines and cosines at octaves, [P, 3 + 6 F] (Mildenhall et al., NeRF, eq. 4)."""
    angles = values[:, None] * 2.0 ** torch.arange(frequencies, device=values.device, dtype=values.dtype)[:, None]
    waves = torch.cat([angles.sin(), angles.cos()], 2)
    return torch.cat([values, waves.flatten(1)], 1)


class MlpField(Field):
    """SDF and colour by the paper's networks, and a background outside; the SDF starts as a sphere of the given
    radius."""

    size: MlpSize

    def __init__(self, size: MlpSize, seed: int = 0, start_radius: float = 0.5) -> None:
        rng = torch.Generator().manual_seed(seed)
        super().__init__()
        self.size, self.start_radius = size, start_radius
        self.background = Background(size.background)
        inputs = 3 + 6 * size.frequencies
        self.skip = size.depth // 2
        layers = []
        for k in range(size.depth + 1):
            before = inputs if k == 0 else size.width
            after = size.width - inputs if k + 1 == self.skip else size.width
            layers.append(nn.Linear(before, after if k < size.depth else 1 + size.width))
        self.geometry = nn.ModuleList(layers)
        self._start_as_sphere(rng, inputs)
        self.color = nn.ModuleList()
        width = 3 + 3 + 6 * size.view_frequencies + 3 + size.width
        for k in range(size.color_depth + 1):
            layer = nn.Linear(width if k == 0 else size.width, size.width if k < size.color_depth else 3)
            with torch.no_grad():
                bound = (6 / layer.in_features) ** 0.5 * (1.0 if k < size.color_depth else 0.3)
                layer.weight.copy_((torch.rand(layer.weight.shape, generator=rng) * 2 - 1) * bound)
                layer.bias.zero_()
            self.color.append(layer)
        # Length and direction of each weight vector are learned separately, as in the paper's code.
        for layers_ in (self.geometry, self.color):
            for k, layer in enumerate(layers_):
                layers_[k] = nn.utils.parametrizations.weight_norm(layer)
        self.raw_beta = nn.Parameter(torch.tensor(0.1))

    @torch.no_grad()
    def _start_as_sphere(self, rng: torch.Generator, inputs: int) -> None:
        """Geometric initialisation (Atzmon and Lipman, SAL, theorem 1): the network is close to |x| - radius."""
        for k, layer in enumerate(self.geometry):
            assert isinstance(layer, nn.Linear)
            layer.bias.zero_()
            if k == self.size.depth:
                mean = math.sqrt(math.pi / layer.in_features)
                layer.weight.copy_(mean + 1e-4 * torch.randn(layer.weight.shape, generator=rng))
                continue
            # The waves start without influence. Weights are orthogonal, while the paper draws every weight
            # independently: this keeps lengths exactly as in the theorem, not only on average.
            layer.weight.zero_()
            seeing = layer.in_features - (inputs - 3 if k in (0, self.skip) else 0)
            tall = torch.randn(max(seeing, layer.out_features), min(seeing, layer.out_features), generator=rng)
            square = torch.linalg.qr(tall).Q
            gain = math.sqrt(2 * max(1.0, seeing / layer.out_features))
            layer.weight[:, :seeing] = gain * (square if seeing <= layer.out_features else square.T)
        # The theorem holds for infinite width; here slope and offset are wrong by some percent. The last layer is
        # linear, so it can correct both.
        points = torch.randn(2000, 3, generator=rng)
        radius = torch.rand(2000, generator=rng)
        points = points / points.norm(dim=1, keepdim=True) * radius[:, None]
        # In closed form, because the last bit of LAPACK's result depends on the memory address of its input.
        found, away = self.sdf(points).double(), radius.double()
        slope = ((away - away.mean()) * found).sum() / (away - away.mean()).square().sum()
        offset = found.mean() - slope * away.mean()
        last = self.geometry[-1]
        assert isinstance(last, nn.Linear)
        last.weight[0] /= slope
        last.bias[0] = -SPAN * (self.start_radius + offset / slope)

    @property
    def beta(self) -> Tensor:
        """Learned scale of the density, normalised units (section 3.1)."""
        return self.raw_beta.abs() / SPAN + 1e-4

    def _network(self, points: Tensor) -> Tensor:
        """SDF and features [P, 1 + width]."""
        start = encoded(SPAN * points, self.size.frequencies)
        hidden = start
        for k, layer in enumerate(self.geometry):
            if k == self.skip:
                hidden = torch.cat([hidden, start], 1) / math.sqrt(2)
            hidden = layer(hidden)
            if k < self.size.depth:
                hidden = functional.softplus(hidden, beta=SHARPNESS)
        return torch.cat([hidden[:, :1] / SPAN, hidden[:, 1:]], 1)

    def sdf(self, points: Tensor) -> Tensor:
        return self._network(points)[:, 0]

    def geometry_at(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """SDF [P], features [P, width], and points with the SDF's gradient [P, 6], at points [P, 3]."""
        keep = torch.is_grad_enabled()
        with torch.enable_grad():
            points = points.detach().requires_grad_(True)
            found = self._network(points)
            (gradient,) = torch.autograd.grad(found[:, 0].sum(), points, create_graph=keep)
        if not keep:
            found, gradient = found.detach(), gradient.detach()
        return found[:, 0], found[:, 1:], torch.cat([points.detach(), gradient], 1)

    def color_of(self, geometry: Tensor, features: Tensor, directions: Tensor) -> Tensor:
        hidden = torch.cat(
            [features[:, :3], encoded(directions, self.size.view_frequencies), features[:, 3:], geometry], 1
        )
        for k, layer in enumerate(self.color):
            hidden = layer(hidden)
            if k < self.size.color_depth:
                hidden = functional.relu(hidden)
        return torch.sigmoid(hidden)
