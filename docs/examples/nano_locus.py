"""All of LocusGS in one file of plain PyTorch: posed photos in, 3D Gaussians and a loss out.

    python docs/examples/nano_locus.py 500

trains a tiny model on scenes of random blobs. The weights are one dictionary `p`, named as in the
framework: the tensors of a checkpoint of recipes/tiny/locus.yaml fit as they are, and a test holds
Gaussians, image, loss and gradients against the framework's, whose files the headings name. The
weights start more simply than the recipe's.

Axes: B scenes, V views, M image tokens (the patches of all views), N queries, K Gaussians a query,
D width, h heads. World: the frame of the first input camera, which the caller gives. Cameras: c2w
(B, V, 4, 4) in OpenCV axes, intrinsics (B, V, 4) fx, fy, cx, cy in pixels; `render` takes one.
"""

import math
import sys
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

WIDTH = 128  # published: 1024
HEADS = 4  # 16
PATCH = 8
ENCODER_DEPTH = 1  # 3
DECODER_DEPTH = 4  # 12
QUERIES = 256  # 1024
PER_QUERY = 8  # Gaussians; 64
LAYER_WEIGHTS = {2: 1 / 3, 4: 2 / 3}  # decoder layers that the loss sees, and how much
NEAR = 0.025  # world units
Gaussians = dict[str, Tensor]


# ---- Blocks: qgs/tokengs/blocks.py ----
class Weights(dict[str, Tensor]):
    """Parameters by name. One that is missing is made where it is first used."""

    def need(self, name: str, *shape: int, start: float | Tensor | None = None) -> Tensor:
        if name not in self:
            bound = math.prod(shape[1:]) ** -0.5  # of a uniform start: by the number of inputs
            made = torch.empty(shape).uniform_(-bound, bound) if start is None else start
            self[name] = (torch.zeros(shape) + made).requires_grad_()
        return self[name]

    def pair(self, name: str, *shape: int) -> tuple[Tensor, Tensor]:
        weight = self.need(f"{name}.weight", *shape, start=None if shape[1:] else 1.0)
        return weight, self.need(f"{name}.bias", shape[0], start=0.0)


def linear(p: Weights, name: str, x: Tensor, outputs: int) -> Tensor:
    return F.linear(x, *p.pair(name, outputs, x.shape[-1]))


def norm(p: Weights, name: str, x: Tensor) -> Tensor:
    return F.layer_norm(x, x.shape[-1:], *p.pair(name, x.shape[-1]))


def scaled(p: Weights, name: str, update: Tensor) -> Tensor:  # LayerScale
    return p.need(f"{name}.gamma", WIDTH, start=0.3) * update


def mlp(p: Weights, name: str, x: Tensor, hidden: int, outputs: int) -> Tensor:
    return linear(p, f"{name}.fc2", F.gelu(linear(p, f"{name}.fc1", x, hidden)), outputs)


def split(x: Tensor) -> Tensor:  # (B, T, D) -> (B, h, T, D/h)
    return x.unflatten(-1, (HEADS, -1)).transpose(1, 2)


def attend(q: Tensor, k: Tensor, v: Tensor, bias: Tensor | None = None) -> Tensor:
    return F.scaled_dot_product_attention(q, k, v, bias).transpose(1, 2).flatten(2)  # (B, T, D)


def self_attention(p: Weights, name: str, x: Tensor) -> Tensor:
    """Multi-head attention with LayerNorm on the queries and keys of each head."""
    q, k, v = (split(part) for part in linear(p, f"{name}.qkv", x, 3 * WIDTH).chunk(3, -1))
    read = attend(norm(p, f"{name}.q_norm", q), norm(p, f"{name}.k_norm", k), v)
    return linear(p, f"{name}.proj", read, WIDTH)


# ---- Rays and encoder: qgs/geometry/rays.py, qgs/tokengs/encoder.py ----
def plucker_map(c2w: Tensor, intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Moment o x d and unit direction d of the ray through each pixel: (B, V, 6, H, W)."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    fx, fy, cx, cy = intrinsics[..., None, None].unbind(-3)
    x = (u - cx) / fx
    in_camera = F.normalize(torch.stack([x, (v - cy) / fy, torch.ones_like(x)], -1), dim=-1)
    d = in_camera @ c2w[..., None, :3, :3].transpose(-1, -2)
    o = c2w[..., None, None, :3, 3].expand_as(d)
    return torch.cat([torch.linalg.cross(o, d, dim=-1), d], -1).movedim(-1, -3)


def patches(p: Weights, name: str, images: Tensor) -> Tensor:  # (B*V, C, H, W) -> (B*V, M/V, D)
    kernel = p.pair(f"{name}.proj", WIDTH, images.shape[1], PATCH, PATCH)
    x = F.conv2d(images, *kernel, stride=PATCH)
    return norm(p, f"{name}.norm", x.flatten(2).transpose(1, 2))


def encode(p: Weights, images: Tensor, c2w: Tensor, intrinsics: Tensor) -> Sequence[Tensor]:
    """Run a ViT over all views; return keys and values (B, h, M, D/h) and patch rays."""
    plucker = plucker_map(c2w, intrinsics, *images.shape[-2:]).flatten(0, 1)
    mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[..., None, None]
    x = patches(p, "encoder.rgb_embedding", ((images - mean) / std).flatten(0, 1))
    x = (x + patches(p, "encoder.ray_embedding", plucker)).reshape(len(images), -1, WIDTH)
    for i in range(ENCODER_DEPTH):
        layer = f"encoder.blocks.{i}"
        update = self_attention(p, f"{layer}.attention", norm(p, f"{layer}.norm1", x))
        x = x + scaled(p, f"{layer}.scale1", update)
        update = mlp(p, f"{layer}.mlp", norm(p, f"{layer}.norm2", x), 4 * WIDTH, WIDTH)
        x = x + scaled(p, f"{layer}.scale2", update)
    k, v = linear(p, "encoder.kv_proj", norm(p, "encoder.norm", x), 2 * WIDTH).chunk(2, -1)
    rays = F.avg_pool2d(plucker, PATCH).flatten(2).transpose(1, 2)
    return norm(p, "encoder.k_norm", split(k)), split(v), rays.reshape(len(images), -1, 6)


# ---- Decoder layer: qgs/tokengs/decoder.py, qgs_locus/{fields,ray_bias,*_attention}.py ----
def support_radius(rho: Tensor) -> Tensor:
    # At 0 all Gaussians of an anchor would be one point, and their offsets get no gradient.
    return F.softplus(rho).clamp_min(1e-3)


def ray_bias(mu: Tensor, rho: Tensor, rays: Tensor) -> Tensor:
    """b (B, N, M) = -1/2 (D / sigma)^2, D the distance of the centre to the ray of a patch."""
    moment, direction = rays.split(3, -1)
    length = direction.norm(dim=-1, keepdim=True)  # below 1: a mean of unit vectors
    moment, direction = (x[:, None] / length[:, None] for x in (moment, direction))
    distance = (torch.linalg.cross(mu[:, :, None], direction, dim=-1) - moment).norm(dim=-1)
    # sigma is at least .032: it follows radii above .316, and the recipe's start at .3. b is at
    # least -20: an anchor far from all rays still attends, by content.
    sigma = (0.1 * support_radius(rho)).square().clamp_min(1e-3).sqrt()
    return (-0.5 * (distance / sigma).square()).clamp_min(-20)


def cross_attention(p: Weights, name: str, x: Tensor, b: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(q k / sqrt(d) + gamma b) v, with one gamma for each layer."""
    q = split(linear(p, f"{name}.core.q_proj", norm(p, f"{name}.core.norm", x), WIDTH))
    bias = F.softplus(p.need(f"{name}.raw_gamma", start=0.54)) * b[:, None]
    read = attend(norm(p, f"{name}.core.q_norm", q), k, v, bias)
    return linear(p, f"{name}.core.out_proj", read, WIDTH)


def anchor_aware(p: Weights, name: str, x: Tensor, mu: Tensor) -> Tensor:
    """Self-attention over x + MLP(PE(mu)); the position is added for this attention only."""
    divisor = 10_000 ** (2 * torch.arange(64) / 128) + 1e-6
    angle = ((torch.tanh(mu) + 1) * math.pi)[..., None] / divisor  # tanh: centres have no bounds
    sines = torch.stack([angle.sin(), angle.cos()], -1).flatten(2)
    position = mlp(p, f"{name}.position_mlp", sines, WIDTH, WIDTH)
    return self_attention(p, f"{name}.attention", norm(p, f"{name}.norm", x + position))


def posact(t: Tensor) -> Tensor:
    """sign(t) (exp|t| - 1), at most 1000: linear near 0, exponential far out, for positions."""
    t = t.clamp(-math.log1p(1000), math.log1p(1000))  # before exp, which would overflow
    return torch.where(t >= 0, torch.expm1(t), -torch.expm1(-t))


# ---- Head, centres: qgs/tokengs/head.py, qgs_locus/decoding.py; qgs/model.py ----
def decode(p: Weights, x: Tensor, mu: Tensor, rho: Tensor) -> Gaussians:
    """N*K Gaussians: means at offsets from the anchor that are multiples of its radius."""
    sizes = (3, 3, 3, 4, 1)
    raw = linear(p, "head.linear", x, PER_QUERY * sum(sizes)).unflatten(-1, (PER_QUERY, -1))
    offset, rgb, scale, quat, opacity = raw.split(sizes, -1)
    parts = {
        "means": mu[:, :, None] + support_radius(rho)[:, :, None] * posact(offset),
        "scales": (scale.clamp(-10, 10) - 1).exp().clamp_max(1) * 0.15,  # at most 0.15, world units
        "quats": F.normalize(quat, dim=-1, eps=1e-4),
        "opacities": torch.sigmoid(opacity[..., 0] - 1),
        "colors": (torch.tanh(rgb) + 1) / 2,
    }
    return {name: part.flatten(1, 2) for name, part in parts.items()}


def forward(p: Weights, *views: Tensor) -> list[tuple[Tensor, Gaussians]]:
    """Return centres (B, N, 3) and Gaussians after each layer. views: images, c2w, intrinsics."""
    k, v, rays = encode(p, *views)
    features = p.need("queries.features", QUERIES, WIDTH)
    box = torch.rand(QUERIES, 3) + torch.tensor([-0.5, -0.5, 0.5])  # before the first camera
    center = p.need("queries.center", QUERIES, 3, start=box)
    raw = p.need("queries.raw_radius", QUERIES, 1, start=-1.05)  # softplus: 0.3
    x, mu, rho = (y.expand(len(k), -1, -1) for y in (features, center, raw))
    layers = []
    for i in range(DECODER_DEPTH):
        layer = f"decoder.{i}"
        b = ray_bias(mu, rho, rays)
        update = cross_attention(p, f"{layer}.cross_attention", x, b, k, v)
        x = x + scaled(p, f"{layer}.cross_scale", update)
        x = x + scaled(p, f"{layer}.self_scale", anchor_aware(p, f"{layer}.self_attention", x, mu))
        normed = norm(p, f"{layer}.feed_forward.norm", x)
        update = mlp(p, f"{layer}.feed_forward.mlp", normed, 4 * WIDTH, WIDTH)
        x = x + scaled(p, f"{layer}.feed_forward_scale", update)
        mu = mu + posact(mlp(p, "refinements.0.center_mlp", x, WIDTH, 3))  # one for all layers
        rho = rho + mlp(p, "refinements.0.radius_mlp", x, WIDTH, 1)
        layers.append((mu, decode(p, x, mu, rho)))
    return layers


# ---- Renderer: qgs/renderers/reference.py, qgs/geometry/transforms.py ----
def rotation(quats: Tensor) -> Tensor:  # (..., 4) w x y z -> (..., 3, 3)
    v = quats[..., None, 1:].expand(*quats.shape[:-1], 3, 3)
    cross = torch.linalg.cross(v, torch.eye(3).expand_as(v), dim=-1).mT  # cross @ y is v x y
    return torch.eye(3) + 2 * (quats[..., :1, None] * cross + cross @ cross)


def render(g: Gaussians, c2w: Tensor, intrinsics: Tensor, size: tuple[int, ...]) -> Tensor:
    """RGB (3, H, W) of a scene's Gaussians from one camera: EWA splatting, front to back."""
    fx, fy, cx, cy = intrinsics
    height, width = size
    turn = c2w[:3, :3].T  # from the world's axes to the camera's
    in_camera = (g["means"] - c2w[:3, 3]) @ turn.T
    seen = ((in_camera[:, 2] >= NEAR) & (in_camera[:, 2] <= 125)).nonzero()[:, 0]
    i = seen[in_camera[seen, 2].argsort(stable=True)]  # front to back
    g = {name: part[i] for name, part in g.items()}
    x, y, z = in_camera[i].unbind(-1)
    # The Jacobian of the projection grows without bound outside the image: slopes stop 15 % out.
    slope_x = (x / z).clamp((-0.15 * width - cx) / fx, (1.15 * width - cx) / fx)
    slope_y = (y / z).clamp((-0.15 * height - cy) / fy, (1.15 * height - cy) / fy)
    rows = [fx / z, 0 * z, -fx / z * slope_x, 0 * z, fy / z, -fy / z * slope_y]
    spread = torch.stack(rows, -1).unflatten(-1, (2, 3)) @ turn @ rotation(g["quats"])
    spread = spread * g["scales"][:, None]
    inverse = (spread @ spread.mT + 0.3 * torch.eye(2)).inverse()  # low-pass of 3DGS, pixel^2
    du = (torch.arange(width) + 0.5 - (fx * x / z + cx)[:, None])[:, None]  # (G, 1, W)
    dv = (torch.arange(height) + 0.5 - (fy * y / z + cy)[:, None])[..., None]  # (G, H, 1)
    xx, xy, _, yy = inverse.flatten(1)[..., None, None].unbind(1)
    power = -0.5 * (xx * du * du + yy * dv * dv) - xy * du * dv
    alpha = g["opacities"][:, None, None] * power.clamp_max(0).exp()
    alpha = torch.where(alpha >= 1 / 255, alpha.clamp_max(0.999), 0.0)  # steps of 8 bits
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after])[:-1]
    weight = torch.where(after > 1e-4, alpha * before, 0.0)  # 3DGS stops before 1e-4 is reached
    rgb = torch.einsum("gc,ghw->chw", g["colors"], weight)
    return rgb + 0.5 * (1 - weight.sum(0))  # over grey


# ---- Losses: qgs/losses, qgs_locus/visibility.py ----
def ssim(x: Tensor, y: Tensor) -> Tensor:
    """Mean structural similarity of (X, 3, H, W), Gaussian windows of 11 pixels, zero padding."""
    line = torch.softmax(-(torch.arange(-5.0, 6.0) ** 2) / (2 * 1.5**2), 0)
    window = torch.outer(line, line).expand(15, 1, 11, 11)
    moments = torch.cat([x, y, x * x, y * y, x * y], 1)
    mx, my, xx, yy, xy = F.conv2d(moments, window, padding=5, groups=15).chunk(5, 1)
    alike = (2 * mx * my + 0.01**2) * (2 * (xy - mx * my) + 0.03**2)
    energy = mx**2 + my**2
    return (alike / ((energy + 0.01**2) * (xx + yy - energy + 0.03**2))).mean()


def out_of_view(points: Tensor, c2w: Tensor, intrinsics: Tensor, size: tuple[int, ...]) -> Tensor:
    """Mean of (|u| - 1)+ + (|v| - 1)+, least over views, at most 1; u, v in [-1, 1] in an image."""
    local = (points[:, None] - c2w[..., None, :3, 3]) @ c2w[..., :3, :3]  # (B, V, P, 3)
    z = torch.where(local[..., 2:].abs() < 1e-3, 1e-3, local[..., 2:])  # finite gradients
    pixel = intrinsics[..., None, :2] * local[..., :2] / z + intrinsics[..., None, 2:]
    outside = (2 * pixel / torch.tensor([size[1], size[0]]) - 1).abs().sub(1).relu().sum(-1)
    outside = torch.where(local[..., 2] <= NEAR, torch.inf, outside)  # published: mirrored
    return outside.amin(1).clamp_max(1).mean()


def loss(p: Weights, inputs: Sequence[Tensor], targets: Sequence[Tensor]) -> Tensor:
    """Return the loss. inputs and targets: images (B, V, 3, H, W), c2w, intrinsics."""
    truth, c2w, intrinsics = targets
    size = tuple(truth.shape[-2:])
    layers = forward(p, *inputs)
    total = torch.zeros(())
    for number, weight in LAYER_WEIGHTS.items():
        mu, gaussians = layers[number - 1]
        images = []
        for b, scene in enumerate(c2w):
            g = {name: part[b] for name, part in gaussians.items()}
            images += [render(g, pose, intrinsics[b, v], size) for v, pose in enumerate(scene)]
        rgb = torch.stack(images)
        y = truth.flatten(0, 1)
        term = F.mse_loss(rgb, y) + 0.2 * (1 - ssim(rgb, y)) / 2
        for points, factor in ((gaussians["means"], 0.1), (mu, 0.01)):
            term = term + factor * out_of_view(points, c2w, intrinsics, size)
        total = total + weight * term
    return total


# ---- Data and the loop: qgs/data/samples.py, qgs/train/training.py ----
def blobs(views: int, size: int = 32) -> list[Tensor]:
    """Draw 40 random blobs from cameras side by side; the first one is the world's frame."""
    g = {
        "means": torch.rand(40, 3) * 1.6 + torch.tensor([-0.8, -0.8, 1]),
        "scales": torch.rand(40, 3) * 0.15 + 0.03,
        "quats": F.normalize(torch.randn(40, 4), dim=-1),
        "opacities": torch.ones(40),
        "colors": torch.rand(40, 3),
    }
    c2w = torch.eye(4).repeat(views, 1, 1)
    c2w[1:, :2, 3] = torch.rand(views - 1, 2) * 0.6 - 0.3
    intrinsics = torch.tensor([size, size, size / 2, size / 2]).expand(views, 4)
    images = [render(g, camera, intrinsics[0], (size, size)) for camera in c2w]
    return [x[None] for x in (torch.stack(images), c2w, intrinsics)]


def main(steps: int) -> None:
    torch.manual_seed(0)
    p = Weights()
    forward(p, *blobs(views=2))  # makes all weights
    optimizer = torch.optim.AdamW(p.values(), lr=1e-3, betas=(0.9, 0.95))
    for step in range(steps):
        scene = blobs(views=4)
        value = loss(p, [x[:, :2] for x in scene], [x[:, 2:] for x in scene])
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(p.values(), 1.0)
        optimizer.step()
        print(f"step {step:4}  loss {value.item():.4f}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
