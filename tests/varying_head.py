"""A head whose Gaussians have colours that depend on the direction, and features."""

from torch import nn

HARMONICS = 8
FEATURES = 4


class VaryingHead(nn.Module):
    """What `head` decodes, with `sh` (B, N, K, 8, 3) and `features` (B, N, K, 4) in addition."""

    def __init__(self, head):
        super().__init__()
        self.head = head
        channels = head.gaussians_per_query * (3 * HARMONICS + FEATURES)
        self.linear = nn.Linear(head.linear.in_features, channels, bias=False)

    def forward(self, state):
        raw = self.linear(state.features).unflatten(-1, (self.head.gaussians_per_query, -1))
        sh, features = raw.split([3 * HARMONICS, FEATURES], -1)
        return self.head(state).replace(sh=sh.unflatten(-1, (HARMONICS, 3)), features=features)
