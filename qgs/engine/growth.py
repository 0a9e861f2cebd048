"""Growth of optimised Gaussians: live ones split, dead ones move to where they are of use.

Source: 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024), without its
noise: copies of a Gaussian lie a part of its size beside it, so that they can part.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from qgs.geometry.transforms import quat_to_matrix
from qgs.memory import refuse_beyond_memory
from qgs.types import Gaussians

DEAD = 0.005
"""Opacity below which a Gaussian moves, as in the paper. More would take away what is seen: of
fog that stands before an object every single one is faint."""
_BESIDE = 0.2  # of a parent's scales: how far a copy lies from it
_MOST_COPIES = 51  # of one Gaussian at a time, as in the paper's code
_COLOR_MARGIN, _OPACITY_MARGIN = 0.02, 1e-4


def refuse_too_many(count: int, gaussians: Gaussians | None = None) -> None:
    """Raise TooLargeError when memory does not hold `count` Gaussians while they are optimised.

    gaussians: (1, G), what they are like; None for those without harmonics and features.
    """
    given = [] if gaussians is None else [gaussians.sh, gaussians.features]
    more = sum(x[0, :1].numel() for x in given if x is not None)
    numbers = (14 + more) * 4  # of a Gaussian; each with its gradient and two moments
    refuse_beyond_memory(
        "a refinement", {f"{count} Gaussians": 4 * numbers * count}, "Take fewer (--gaussians)."
    )


class Leaves:
    """Gaussians (1, G) as tensors (G, ...) without bounds, and Adam on them.

    values: means, log_scales, quats, opacity_logits, color_logits (beside sh, which allow any
    colour, colors as they are), and sh and features if there are, by name.
    """

    def __init__(self, gaussians: Gaussians, rates: Mapping[str, float]) -> None:
        free = gaussians.sh is not None
        values = {
            "means": gaussians.means,
            "log_scales": gaussians.scales.clamp_min(1e-7).log(),
            "quats": gaussians.quats,
            "opacity_logits": gaussians.opacities.logit(_OPACITY_MARGIN),
            "color_logits": None if free else gaussians.colors.logit(_COLOR_MARGIN),
            "colors": gaussians.colors if free else None,
            "sh": gaussians.sh,
            "features": gaussians.features,
        }
        given = {name: value for name, value in values.items() if value is not None}
        self.values = {k: v[0].detach().float().clone().requires_grad_() for k, v in given.items()}
        groups = [
            {"params": [self.values[name]], "name": name, "lr": rates[name]} for name in given
        ]
        self.optimizer = torch.optim.Adam(groups, eps=1e-15)

    @property
    def count(self) -> int:
        """Gaussians at present."""
        return len(self.values["means"])

    def gaussians(self) -> Gaussians:
        """Gaussians (1, G) with gradients to `values`."""
        v = {name: value[None] for name, value in self.values.items()}
        shape = v["log_scales"].exp(), F.normalize(v["quats"], dim=-1)
        colors = v["colors"] if "colors" in v else v["color_logits"].sigmoid()
        look = v["opacity_logits"].sigmoid(), colors
        return Gaussians(v["means"], *shape, *look, v.get("sh"), v.get("features"))

    @torch.no_grad()
    def grow(self, count: int, generator: torch.Generator) -> None:
        """Relocate the dead, and add Gaussians up to `count`; those drawn by opacity are split.

        Parents and copies share the parent's opacity and shrink, so that the rendering stays.
        Moments of all of them start anew. Where all are faint, none is dead.
        """
        opacities = self.values["opacity_logits"].sigmoid()
        faint = (opacities < DEAD) & (opacities >= DEAD).any()
        dead = faint.nonzero()[:, 0]
        needed = len(dead) + max(count - self.count, 0)
        weights = torch.where(faint, 0, opacities).cpu()
        if not needed:
            return
        parents = torch.multinomial(weights, needed, replacement=True, generator=generator)
        parents = parents.to(opacities.device)
        self._split(parents)
        places = self._places_in(parents, generator)
        for group in self.optimizer.param_groups:
            (old,), name = group["params"], group["name"]
            copies = places if name == "means" else old[parents]
            new = torch.cat([old.index_copy(0, dead, copies[: len(dead)]), copies[len(dead) :]])
            state = self.optimizer.state.pop(old, {})
            for moment in state.keys() & {"exp_avg", "exp_avg_sq"}:
                kept = state[moment].index_fill(0, torch.cat([dead, parents]), 0)
                state[moment] = torch.cat([kept, torch.zeros_like(copies[len(dead) :])])
            leaf = new.requires_grad_()
            group["params"], self.values[name] = [leaf], leaf
            self.optimizer.state[leaf] = state

    def _split(self, parents: Tensor) -> None:
        """Give every parent the opacity and the size that it shares with its copies."""
        shares = torch.bincount(parents, minlength=self.count) + 1
        chosen = (shares > 1).nonzero()[:, 0]
        logits = self.values["opacity_logits"]
        opacity, shrink = shared(logits[chosen].sigmoid(), shares[chosen])
        logits[chosen] = opacity.clamp(DEAD, 1 - _OPACITY_MARGIN).logit()
        self.values["log_scales"][chosen] += shrink.log()[:, None]

    def _places_in(self, parents: Tensor, generator: torch.Generator) -> Tensor:
        """A point (n, 3) drawn about the centre of each of `parents`."""
        values = self.values
        turns = quat_to_matrix(F.normalize(values["quats"][parents], dim=-1))
        drawn = torch.randn(len(parents), 3, 1, generator=generator).to(turns)
        steps = turns @ (values["log_scales"][parents].exp()[..., None] * drawn)
        return values["means"][parents] + _BESIDE * steps[..., 0]


def shared(opacities: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity of each of `shares` equal Gaussians in place of one, and the factor of its scales.

    opacities: (n,). shares: (n,) integers, counted as _MOST_COPIES where they are more.
    Equation 9 of the paper: the sum over k of C(N, k+1) (-1)^k / sqrt(k+1) a^(k+1), in float64.
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
