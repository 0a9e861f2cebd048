"""`landmark/neighbours`: each query attends to the queries with nearest anchors."""

import torch
import torch.nn.functional as F
from pydantic import PositiveInt
from qgs_locus.fields import CENTER, CENTER_FIELD
from torch import Tensor, nn

from qgs.contracts import AttentionWeights, ModelDims
from qgs.precision import at_least_float32, full_precision
from qgs.tokengs import ContentSelfAttention, Mlp
from qgs.tokengs.blocks import attention_weights, merge_heads
from qgs.types import QueryState

MAX_PAIRS = 1 << 22
"""Largest number of distances in memory at once (16 MiB in float32)."""
PLACE = 5
"""Number of values in a relative position; `NeighbourAttention` lists these values."""
EPS = 1e-6


class NeighbourAttention(ContentSelfAttention):
    """Self-attention of each query i to the queries j with the k nearest anchors, i included.

    The weights are softmax_j(q_i k_j / sqrt(d) + MLP(p_ij)). The result averages the values v_j and
    the relative positions p_ij. A relative position has five numbers: the vector
    (mu_j - mu_i) / s_i, the length of this vector, and log s_i. mu is an anchor's centre. The reach
    s_i is the distance from i to the farthest of the k anchors, so the vectors do not depend on how
    dense the anchors are.
    """

    name = "neighbours"
    reads = CENTER_FIELD
    # This bias adds the same number to all logits of an anchor.
    unlearned = ("place_mlp.fc2.bias",)

    class Config(ContentSelfAttention.Config):
        count: PositiveInt = 16
        """k, the number of nearest anchors that each query reads. If there are fewer anchors, it
        reads all."""
        hidden: PositiveInt = 32
        """Hidden width of the MLP that maps a relative position to one logit per head."""

    config: Config

    def __init__(self, config: Config, dims: ModelDims) -> None:
        super().__init__(config, dims)
        self.place_mlp = Mlp(PLACE, config.hidden, dims.heads)
        self.place_proj = nn.Linear(PLACE * dims.heads, dims.width, bias=False)

    def forward(self, state: QueryState) -> Tensor:
        """Return the update (B, N, D) of the queries' features."""
        index_BNk, place_BNkP, bias_BhNk = self._near(state)
        q_BhNd, k_BhNd, v_BhNd = self.attention.project(self.norm(state.features))
        near_k, near_v = (_taken(x, index_BNk) for x in (k_BhNd, v_BhNd))
        logits = torch.einsum("bhnd,bhnkd->bhnk", q_BhNd, near_k) * q_BhNd.shape[-1] ** -0.5
        share_BhNk = (at_least_float32(logits) + bias_BhNk).softmax(-1)
        read_BhNd = torch.einsum("bhnk,bhnkd->bhnd", share_BhNk.to(near_v.dtype), near_v)
        where_BhNP = torch.einsum("bhnk,bnkp->bhnp", share_BhNk, place_BNkP)
        return self.attention.proj(merge_heads(read_BhNd)) + self.place_proj(
            merge_heads(where_BhNP)
        )

    def explain(self, state: QueryState, queries: Tensor) -> AttentionWeights:
        """Return the attention weights of the queries with indices `queries`.

        There is a weight for each of the N queries: 0 for a query that is no neighbour.
        """
        index_BNk, _, bias_BhNk = self._near(state)
        q_BhNd, k_BhNd, _ = self.attention.project(self.norm(state.features))
        chosen = bias_BhNk[:, :, queries]
        hidden = chosen.new_full((*chosen.shape[:3], k_BhNd.shape[2]), -torch.inf)
        index = index_BNk[:, None, queries].expand_as(chosen)
        return attention_weights(q_BhNd[:, :, queries], k_BhNd, hidden.scatter(-1, index, chosen))

    def _near(self, state: QueryState) -> tuple[Tensor, Tensor, Tensor]:
        """Return neighbours' indices (B, N, k), relative positions (B, N, k, 5) and a bias.

        An MLP computes the bias (B, h, N, k) of the attention logits from the relative positions.
        The bias is -inf for masked neighbours.
        """
        index_BNk, seen_BNk = nearest(state[CENTER], self.config.count, state.mask)
        place_BNkP = relative_places(state[CENTER], index_BNk, seen_BNk)
        bias_BNkh = at_least_float32(self.place_mlp(place_BNkP))
        bias_BhNk = bias_BNkh.permute(0, 3, 1, 2)
        if seen_BNk is not None:
            bias_BhNk = bias_BhNk.masked_fill(~seen_BNk[:, None], -torch.inf)
        return index_BNk, place_BNkP, bias_BhNk


@torch.no_grad()
@full_precision
def nearest(center_BN3: Tensor, count: int, mask_BN: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Return indices (B, N, k) of the k nearest anchors of each anchor, and a mask (B, N, k).

    The result's mask is True for neighbours that attention may read, or None without `mask_BN`. k
    is `count`, or the number of all anchors if that is less. The search is exact. Each anchor is
    its own first neighbour, which attention may always read.
    """
    scenes, anchors, _ = center_BN3.shape
    # One part if all distances fit: torch.compile makes a graph for each number of parts.
    rows = anchors if scenes * anchors**2 <= MAX_PAIRS else max(1, MAX_PAIRS // (scenes * anchors))
    found = []
    own_N = torch.arange(anchors, device=center_BN3.device)
    for part_BR3, own_R in zip(center_BN3.split(rows, 1), own_N.split(rows), strict=True):
        # Not |a|^2 + |b|^2 - 2 ab, which loses all digits for close anchors far from the origin.
        distance = torch.cdist(part_BR3, center_BN3, compute_mode="donot_use_mm_for_euclid_dist")
        if mask_BN is not None:
            distance = distance.masked_fill(~mask_BN[:, None], torch.inf)
        distance = distance.masked_fill(own_N == own_R[:, None], -1)
        found.append(distance.topk(min(count, anchors), largest=False).indices)
    index_BNk = torch.cat(found, 1)
    if mask_BN is None:
        return index_BNk, None
    seen_BNk = mask_BN[:, None].expand(-1, anchors, -1).gather(2, index_BNk)
    # An anchor always sees itself; with no neighbour at all the softmax would be NaN.
    return index_BNk, seen_BNk | (index_BNk == index_BNk[..., :1])


@full_precision
def relative_places(center_BN3: Tensor, index_BNk: Tensor, seen_BNk: Tensor | None) -> Tensor:
    """Return relative positions (B, N, k, 5) of neighbours, as `NeighbourAttention` defines them.

    A neighbour with `seen_BNk` False is masked: its position counts as that of the query's anchor.
    """
    around_BNk3 = _taken(center_BN3[:, None], index_BNk)[:, 0]
    step_BNk3 = around_BNk3 - center_BN3[:, :, None]
    if seen_BNk is not None:
        step_BNk3 = torch.where(seen_BNk[..., None], step_BNk3, 0.0)
    reach_BN1 = (step_BNk3.square().sum(-1).amax(-1) + EPS**2).sqrt()[..., None, None]
    step_BNk3 = step_BNk3 / reach_BN1
    length_BNk1 = (step_BNk3.square().sum(-1, keepdim=True) + EPS).sqrt()
    return torch.cat([step_BNk3, length_BNk1, reach_BN1.log().expand_as(length_BNk1)], -1)


def _taken(x_BhNd: Tensor, index_BNk: Tensor) -> Tensor:
    """Return the rows of `x` (B, h, N, d) at the neighbours `index` (B, N, k): (B, h, N, k, d)."""
    # Whole rows: `gather` copies single numbers (10 ms, not 3, for 512 anchors on a CPU).
    scenes, heads, anchors, _ = x_BhNd.shape
    first = torch.arange(scenes * heads, device=index_BNk.device).view(scenes, heads, 1, 1)
    return F.embedding(first * anchors + index_BNk[:, None], x_BhNd.flatten(0, 2))
