"""Fit of the two parts that a lobe is looked up by, ``tron/brdf/lobe_parts.npy``; knows no picture.

    python dev/lobe_parts.py tron/brdf/lobe_parts.npy

A prefiltered map knows round lobes; one that is seen aslant is long and leans. Two round ones with the mean
of the lobe together stand for it:

    w, m1 = m + d, m2 = m - w / (1 - w) d        d = x s (n - (n.u) u) + y s^2 u

m is the lobe's mean direction, u its unit vector, s^2 = 1 - |m|^2; a round lobe has the width that belongs to
the length of its mean. w, x and y are fitted for F0 of 0.04 and of 1, by roughness and n.v, to the lobe's
harmonics: photographed light has power that falls with the square of the degree (Dror, Willsky and Adelson
2004, "Statistical characterization of real-world illumination"), so the expected square of what the lookup
is off by is the sum of the squares of the harmonics' differences over the degree's square.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tron.brdf.table import PARTS_F0, PARTS_SMOOTHEST
from tron.shading.environments.prefilter import lobe_length

DEGREE = 48
NODES = 12
"""Along roughness and n.v each."""
F0 = (PARTS_F0, 1.0)
POINTS = 64
STEPS, RATE, SMOOTH = 400, 0.02, 2e-2
Pair = tuple[int, int]
ORDERS: list[Pair] = [(degree, m) for m in range(DEGREE + 1) for degree in range(m, DEGREE + 1)]


def harmonics(z: Tensor, s: Tensor) -> list[Tensor]:
    """Associated Legendre functions of :data:`ORDERS`, normalised over the sphere, of cosines and sines."""
    found: dict[Pair, Tensor] = {}
    corner = torch.full_like(z, (4 * np.pi) ** -0.5)
    for m in range(DEGREE + 1):
        if m:
            corner = -corner * s * ((2 * m + 1) / (2 * m)) ** 0.5
        before, last = torch.zeros_like(z), corner
        found[m, m] = last
        for n in range(m + 1, DEGREE + 1):
            scale = ((4 * n * n - 1) / (n * n - m * m)) ** 0.5
            back = (((n - 1) ** 2 - m * m) / (4 * (n - 1) ** 2 - 1)) ** 0.5 if n > 1 else 0.0
            before, last = last, scale * (z * last - back * before)
            found[n, m] = last
    return [found[order] * (2**0.5 if order[1] else 1) for order in ORDERS]


def lobe(roughness: float, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(C, N, 3) directions, mirror's towards +x, and (C, N) their weights of F0 and of its complement."""
    a = roughness**2
    i = np.arange(POINTS * POINTS)
    x = (i % POINTS + 0.5) / POINTS
    share, turn = 3 * x * x, 2 * np.pi * ((i // POINTS + 0.5) / (2 * POINTS) - 0.25)
    view = np.stack([-np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1)
    top = view * [a, 1, 1]
    top /= np.linalg.norm(top, axis=-1, keepdims=True)
    across = np.broadcast_to([0.0, -1.0, 0.0], top.shape)
    along = np.cross(top, across)
    radius = np.sqrt(1 - x**3)
    u, v = radius * np.cos(turn), radius * np.sin(turn)
    squeeze = 0.5 * (1 + top[:, 2:])
    v = (1 - squeeze) * np.sqrt(np.maximum(1 - u * u, 0)) + squeeze * v
    w = np.sqrt(np.maximum(1 - u * u - v * v, 0))
    half = (u[..., None] * across[:, None] + v[..., None] * along[:, None] + w[..., None] * top[:, None]) * [
        a,
        a,
        1,
    ]
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    facing = (half * view[:, None]).sum(-1)
    out = 2 * facing[..., None] * half - view[:, None]

    def slope(z: np.ndarray) -> np.ndarray:
        return np.sqrt(a * a + (1 - a * a) * z * z)

    c, z = cosine[:, None], np.maximum(out[..., 2], 1e-9)
    weight = share * z * (c + slope(c)) / (z * slope(c) + c * slope(z)) / share.sum()
    weight = np.where((out[..., 2] > 0) & (facing > 0), weight, 0)
    fresnel = (1 - np.clip(facing, 0, 1)) ** 5
    return out, weight * (1 - fresnel), weight * fresnel


def seen_lobes(roughness: np.ndarray, cosine: np.ndarray) -> tuple[Tensor, Tensor]:
    """(2, R, C, K) harmonics of the lobes of either F0, of light 1, and (2, R, C, 2) means along x and z."""
    every = []
    for each in roughness:
        out, scale, bias = lobe(float(each), cosine)
        d = torch.tensor(out)
        phi = torch.atan2(d[..., 1], d[..., 0])
        base = harmonics(d[..., 2], (1 - d[..., 2] ** 2).clamp(min=0).sqrt())
        weights = [torch.tensor((f0 * scale + bias) / (f0 * scale + bias).sum(1, keepdims=True)) for f0 in F0]
        turned = [torch.cos(m * phi) for m in range(DEGREE + 1)]
        shape = [
            [(w * y * turned[m]).sum(-1) for y, (_, m) in zip(base, ORDERS, strict=True)] for w in weights
        ]
        means = [(w[..., None] * d).sum(1)[:, [0, 2]] for w in weights]
        every.append((torch.stack([torch.stack(s, -1) for s in shape]), torch.stack(means)))
    return torch.stack([s for s, _ in every], 1), torch.stack([m for _, m in every], 1)


class RoundLobes:
    """Zonal factors of the lobes of a prefiltered map by the length of their mean, 1 - x^4 / 3."""

    def __init__(self, entries: int = 256) -> None:
        roughness = np.linspace(0.02, 0.9999, 400)
        width = [(3 * (1 - lobe_length(each**2))) ** 0.25 for each in roughness]
        nodes, weights = np.polynomial.legendre.leggauss(400)
        factors = []
        for each in np.interp(np.linspace(0, 1, entries), width, roughness):
            least, most = each**4, (1 + each**4) / 2
            spread = least * (most / least) ** ((nodes + 1) / 2)
            z = 1 - 2 * (spread - least) / (1 - each**4)
            mass = weights * z / spread
            factors.append(np.polynomial.legendre.legvander(z, DEGREE).T @ mass / mass.sum())
        self.factors, self.last = torch.tensor(np.array(factors)), entries - 1

    def __call__(self, mean: Tensor) -> Tensor:
        """(..., K) harmonics of lobes with means (..., 2)."""
        length = mean.norm(dim=-1)
        place = ((1 - length) * 3).clamp(1e-6, 1) ** 0.25 * self.last
        entry = place.detach().long().clamp(max=self.last - 1)
        part = (place - entry)[..., None]
        zonal = self.factors[entry] * (1 - part) + self.factors[entry + 1] * part
        x, z = (mean / length[..., None]).unbind(-1)
        return zonal[..., [n for n, _ in ORDERS]] * torch.stack(harmonics(z, x), -1)


def parts(found: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """w, m1 and m2 of w's logit, x and y, (..., 3)."""
    share, length = torch.sigmoid(found[..., :1]), mean.norm(dim=-1, keepdim=True)
    along, spread = mean / length, (1 - length**2).clamp(min=0).sqrt()
    up = torch.tensor([0.0, 1.0], dtype=mean.dtype)
    off = spread * found[..., 1:2] * (up - along[..., 1:] * along) + spread**2 * found[..., 2:] * along
    return share[..., 0], mean + off, mean - off * share / (1 - share)


def fitted() -> np.ndarray:
    """(2, NODES, NODES, 3) float32: w, x and y by F0, roughness and n.v."""
    roughness = np.linspace(PARTS_SMOOTHEST, 1, NODES)
    cosine = (np.arange(NODES) + 0.5) / NODES
    shape, mean = seen_lobes(roughness, cosine)
    round_lobes = RoundLobes()
    falloff = torch.tensor([(n + 0.5) ** -2 for n, _ in ORDERS])
    single = (falloff * (round_lobes(mean) - shape) ** 2).sum(-1)
    found = torch.zeros(2, NODES, NODES, 3, dtype=torch.float64)
    found[..., 1] = 0.5
    found.requires_grad_(True)
    optimizer = torch.optim.Adam([found], RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS, RATE / 30)
    for step in range(STEPS):
        share, one, two = parts(found, mean)
        both = share[..., None] * round_lobes(one) + (1 - share)[..., None] * round_lobes(two)
        off = (falloff * (both - shape) ** 2).sum(-1)
        beyond = sum(torch.relu(each.norm(dim=-1) - 0.9999).sum() for each in (one, two))
        rough = sum(found.diff(dim=axis).square().sum() for axis in (1, 2))
        loss = (off / single).sum() + 1e3 * beyond + SMOOTH * rough
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 50 == 49:
            print(step + 1, float(loss.detach()), (off / single).mean((1, 2)).sqrt().tolist(), flush=True)
    result = found.detach()
    result[..., 0] = torch.sigmoid(result[..., 0])
    return result.numpy().astype(np.float32)


if __name__ == "__main__":
    np.save(Path(sys.argv[1]), fitted())
