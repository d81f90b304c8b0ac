"""How the program that a scan's splats were learnt with shows them to a camera.

A splat was optimised as a projection that is never thinner than a pixel. As a disk in space, what is thin and
seen edge on is gone. With ``S`` the covariance of a projection, in square pixels, and ``v`` the variance of
the pixel's filter,

    S' = S + v I,     opacity' = opacity sqrt(det S / det S') where compensated, else opacity

(Kerbl et al. 2023, its reference code, whose ``--antialiasing`` compensates; Yu et al. 2024, section 4.2).
2DGS draws disks in space, and instead of them, where it is larger, a Gaussian of variance ``v`` about the
projected centre (Huang et al. 2024, equation 11).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

FILTER = "filter_3D"
"""Property of Mip-Splatting's files."""


class Projection(NamedTuple):
    """A pixel's low-pass filter over projected splats.

    Attributes:
        variance: added to every projected covariance, square pixels.
        compensated: whether opacity is lowered so that a splat keeps its integral.
        larger: whether the larger of disk and filter is drawn.
    """

    variance: float
    compensated: bool
    larger: bool = False


DISKS = "disks"
PROJECTIONS: dict[str, Projection | None] = {
    DISKS: None,
    "3dgs": Projection(0.3, False),
    "antialiased": Projection(0.3, True),
    "mip": Projection(0.1, True),
    "2dgs": Projection(0.5, False, larger=True),
}
"""By name, as scenes have it; surfels of our own are disks in space to cameras as to all other rays."""


def stated_projection(properties: Collection[str], comments: Sequence[str], antialiased: bool = False) -> str:
    """The name of how a file of another program is to be projected, by what it says; "3dgs" if nothing.

    Splats of two scales are 2DGS's, as are those of ``SplatRenderMode: 2dgs``, which splat-transform writes.
    Mip-Splatting's files have its ``filter_3D``, Brush's say ``SplatRenderMode: mip``, those of .spz have a
    flag for splats that were learnt antialiased.

    Args:
        properties: names of the vertex element's properties. comments: of the header.
        antialiased: flag of a file of .spz.
    """
    modes = [
        comment.lower().split()[1:] for comment in comments if comment.lower().startswith("splatrendermode:")
    ]
    if "scale_2" not in properties or ["2dgs"] in modes:
        return "2dgs"
    if FILTER in properties or ["mip"] in modes:
        return "mip"
    return "antialiased" if antialiased else "3dgs"
