"""Add copies of opaque Gaussians during the optimisation; replace nearly transparent Gaussians.

Source: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024). The paper adds
noise to positions. Here a copy is displaced by a fraction of its parent's size, so that copy and
parent can separate.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.transforms import quat_to_matrix
from qgs.types import Gaussians

DEAD = 0.005
"""Opacity below which a Gaussian counts as dead and is relocated; the value is that of the paper. A
higher threshold would remove faint Gaussians, which show fog."""
# Displacement of a copy over its parent's scales.
_BESIDE = 0.2
# Copies of one Gaussian at a time, as in the paper's code.
_MOST_COPIES = 51
_OPACITY_MARGIN = 1e-4


class FreeGaussians:
    """Gaussians (1, G) as parameters (G, ...) without bounds, and their Adam optimizer.

    values: the parameters by name: means, log_scales, quats, opacity_logits, colors, and sh and
    features if given. rates: learning rate by name.
    """

    def __init__(self, gaussians: Gaussians, rates: Mapping[str, float]) -> None:
        given = {
            "means": gaussians.means,
            "log_scales": gaussians.scales.clamp_min(1e-7).log(),
            "quats": gaussians.quats,
            "opacity_logits": gaussians.opacities.logit(_OPACITY_MARGIN),
            "colors": gaussians.colors,
            "sh": gaussians.sh,
            "features": gaussians.features,
        }
        self.values = {
            name: value[0].detach().float().clone().requires_grad_()
            for name, value in given.items()
            if value is not None
        }
        self.optimizer = torch.optim.Adam(
            [
                {"params": [value], "name": name, "lr": rates[name]}
                for name, value in self.values.items()
            ],
            # what other photos asked for is soon forgotten
            betas=(0.9, 0.97),
            eps=1e-15,
            fused=True,
        )
        self.averaged = 0

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.values["means"])

    def gaussians(self) -> Gaussians:
        """Return the Gaussians (1, G); gradients flow to `values`."""
        values = self.values
        return Gaussians(
            means=values["means"],
            scales=values["log_scales"].exp(),
            quats=F.normalize(values["quats"], dim=-1),
            opacities=values["opacity_logits"].sigmoid(),
            colors=values["colors"],
            sh=values.get("sh"),
            features=values.get("features"),
        )[None]

    @torch.no_grad()
    def average(self) -> None:
        """Include the values in the mean of all values since the last growth."""
        if not self.averaged:
            self.mean = {name: value.clone() for name, value in self.values.items()}
        self.averaged += 1
        for name, mean in self.mean.items():
            mean.lerp_(self.values[name], 1 / self.averaged)

    @torch.no_grad()
    def settle(self) -> None:
        """Replace the values by their mean, if there is one."""
        if self.averaged:
            for name, mean in self.mean.items():
                self.values[name].copy_(mean)

    @torch.no_grad()
    def grow(self, count: int, generator: torch.Generator) -> None:
        """Turn dead Gaussians into copies of opaque ones, and add further copies up to `count`.

        The Gaussians to copy (parents) are sampled in proportion to opacity. A parent and its
        copies become smaller and more transparent, so that together they render as the parent did.
        Their Adam moments restart at 0. Gaussians are sorted along a curve, because renderers are
        faster if neighbours lie together in memory. A Gaussian is dead if its opacity is below
        DEAD; if all opacities are below DEAD, none counts as dead.
        """
        opacities = self.values["opacity_logits"].sigmoid()
        faint = (opacities < DEAD) & (opacities >= DEAD).any()
        dead = faint.nonzero()[:, 0]
        needed = len(dead) + max(count - self.count, 0)
        if not needed:
            return
        # on the CPU, as the generator is
        weights = torch.where(faint, 0, opacities).cpu()
        parents = torch.multinomial(weights, needed, replacement=True, generator=generator)
        parents = parents.to(opacities.device)
        self.averaged = 0
        self._split(parents)
        places = self._places_in(parents, generator)
        order = along_curve(_with_copies(self.values["means"], dead, places))
        for group in self.optimizer.param_groups:
            name = group["name"]
            old = self.values[name]
            copies = places if name == "means" else old[parents]
            new = _with_copies(old, dead, copies)[order].requires_grad_()
            # Adam knows tensors by identity: moments follow to the new one
            state = self.optimizer.state.pop(old, {})
            for moment in state.keys() & {"exp_avg", "exp_avg_sq"}:
                kept = state[moment].index_fill(0, parents, 0)
                state[moment] = _with_copies(kept, dead, torch.zeros_like(copies))[order]
            group["params"] = [new]
            self.values[name] = new
            self.optimizer.state[new] = state

    def _split(self, parents: Tensor) -> None:
        """Set the opacity and scale of every parent to the values that parent and copies share."""
        shares = torch.bincount(parents, minlength=self.count) + 1
        chosen = shares > 1
        logits = self.values["opacity_logits"]
        opacity, shrink = shared(logits[chosen].sigmoid(), shares[chosen])
        logits[chosen] = opacity.clamp(DEAD, 1 - _OPACITY_MARGIN).logit()
        self.values["log_scales"][chosen] += shrink.log()[:, None]

    def _places_in(self, parents: Tensor, generator: torch.Generator) -> Tensor:
        """Return random points (n, 3), each near the centre of one of the `parents` (n,)."""
        values = self.values
        turns = quat_to_matrix(F.normalize(values["quats"][parents], dim=-1))
        drawn = torch.randn(len(parents), 3, 1, generator=generator).to(turns)
        steps = turns @ (values["log_scales"][parents].exp()[..., None] * drawn)
        return values["means"][parents] + _BESIDE * steps[..., 0]


def shared(opacities: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Return the opacity a and the scale factor of N equal Gaussians that replace one Gaussian.

    opacities: (n,), of the replaced Gaussians. shares: (n,) integers N, clamped to _MOST_COPIES.
    The factor is the old opacity over the sum of C(N, k+1) (-1)^k / sqrt(k+1) a^(k+1) for k from 0
    to N - 1 (Kheradmand et al. 2024, equation 9). The sum is in float64: its terms cancel.
    """
    shares = shares.clamp_max(_MOST_COPIES).double()
    old = opacities.double()
    new = 1 - (1 - old) ** (1 / shares)
    terms = torch.arange(1.0, int(shares.max()) + 1, dtype=torch.float64, device=old.device)
    total = shares[:, None] + 1
    choose = total.lgamma() - (terms + 1).lgamma() - (total - terms).clamp_min(1).lgamma()
    signs = torch.where(terms % 2 == 1, 1.0, -1.0) / terms.sqrt()
    each = signs * (choose + terms * new.log()[:, None]).exp()
    factor = old / torch.where(terms <= shares[:, None], each, 0).sum(-1)
    return new.to(opacities), factor.to(opacities)


def along_curve(points: Tensor) -> Tensor:
    """Return the order (n,) of `points` (n, 3) along a Morton curve, on which neighbours are near.

    Each coordinate is replaced by its rank in 1,024 steps, so that far points do no harm.
    """
    ranks_N3 = points.argsort(dim=0, stable=True).argsort(dim=0) * 1024 // len(points)
    bits_N3B = ranks_N3[..., None] >> torch.arange(10, device=points.device) & 1
    places_3B = torch.arange(30, device=points.device).view(10, 3).T
    return (bits_N3B << places_3B).sum((1, 2)).argsort(stable=True)


def _with_copies(values: Tensor, dead: Tensor, copies: Tensor) -> Tensor:
    """Return `values` (G, ...) with the first copies at indices `dead`, and the others added."""
    moved, added = copies.tensor_split([len(dead)])
    return torch.cat([values.index_copy(0, dead, moved), added])
