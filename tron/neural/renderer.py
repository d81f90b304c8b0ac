"""The neural renderer: draws a picture from guidance in one pass through a backbone between latents."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from tron.errors import TronError
from tron.neural.clips import Motion, Overlap, averaged_frames, check_frames, windows
from tron.neural.codecs.registry import CODECS
from tron.neural.configs import MEAN, BackboneConfig, RendererConfig, UNetConfig, check_weights
from tron.neural.kernels import filtered, gaussian_logits
from tron.neural.networks.unet import UNet
from tron.neural.protocols import Codec, Renderer
from tron.neural.scales import halved, with_coarse

if TYPE_CHECKING:
    from tron.neural.networks.backbone import Backbone

log = logging.getLogger(__name__)

PLAIN_TIMESTEP = 0.2  # what the tiny transformer is told; any constant will do
TILE = 1024
"""Side of a tile of a large picture, without its margin, pixels."""
BLUR_SIDE = 5
"""Side in pixels of the kernel of skip_blur; skip_kernel has its own side."""
REACH = 96
"""Distance in pixels beyond which a change of guidance changes the shipped U-Nets' pictures below 1/255."""
HARDLY = -7.0
"""Initial log weight of each neighbour in a dilated kernel, relative to the pixel itself."""


def _backbone(shape: UNetConfig | BackboneConfig, given: int, predicted: int) -> Backbone | UNet:
    if isinstance(shape, UNetConfig):
        return UNet(shape, given, predicted)
    from tron.neural.networks.backbone import Backbone  # diffusers, which the shipped networks do without

    return Backbone(shape, given, predicted)


def predicted(config: RendererConfig, channels: int) -> list[int]:
    """Return how many numbers per pixel the backbone predicts: colour, kernel, detail, dilated kernel."""
    taps = config.skip_kernel**2
    detail = 0 if config.skip_detail is None else channels
    return [channels, taps, detail, taps if config.skip_holes else 0]


class NeuralRenderer(Renderer):
    """Codec, backbone, codec. Untrained, without sigma, it returns the buffer of `skip`, filtered."""

    config: RendererConfig

    def __init__(self, config: RendererConfig | None = None, codec: Codec | None = None):
        """config: see RendererConfig; codec: made from the config unless it needs weights, then required."""
        super().__init__()
        self.config = config or RendererConfig()
        if self.config.codec not in CODECS:
            raise TronError(f"no codec is called {self.config.codec!r}", mend=f"they are {', '.join(CODECS)}")
        self.codec: Codec = codec if codec is not None else CODECS[self.config.codec](None)
        self.temporal_factor, self.space_block = self.codec.temporal_factor, self.codec.space_block
        check_frames(self.config.window, self.temporal_factor)
        channels = self.codec.latent_channels
        latents = len(self.config.guidance) if self.config.fusion == "concat" else 1
        shape = self.config.backbone
        self._predicted = predicted(self.config, channels)
        self.backbone: Backbone | UNet = _backbone(shape, latents * channels, sum(self._predicted))

    @property
    def reach(self) -> int | None:
        """As Renderer.reach: for U-Nets on pixels, whose receptive field is larger than this."""
        shape = self.config.backbone
        if not isinstance(shape, UNetConfig) or shape.attention or self.config.codec != "pixels":
            return None
        kernels = self.config.skip_kernel // 2 * (2 + self.config.skip_holes if self.config.skip_holes else 1)
        return (REACH + kernels) * self.config.scales

    @property
    def stride(self) -> int:
        """As Renderer.stride."""
        return (
            self.backbone.stride * self.config.scales if isinstance(self.backbone, UNet) else self.space_block
        )

    def forward(self, buffers: Mapping[str, Tensor], weights: Mapping[str, float] | None = None) -> Tensor:
        """As Renderer.forward, with 1 + temporal_factor * n frames of any H and W.

        Sides are padded to the codec's block by repeating the edge, and cropped again. Weights that are all 0
        are taken here, where everything before lets none through: the backbone is then given zeros. Raises
        TronError for another number of frames.
        """
        videos = [self._padded(video) for video in self.stacked(buffers)]
        height, width = next(iter(buffers.values())).shape[-2:]
        check_frames(videos[0].shape[2], self.temporal_factor)
        drawn = self._drawn(videos, self._scales(weights))
        if self.config.scales == 2:
            coarse = self._drawn(halved(dict(zip(self.config.guidance, videos))), self._scales(weights))
            drawn = with_coarse(drawn, coarse)
        return self.codec.decode(drawn)[..., :height, :width]

    def _drawn(self, videos: list[Tensor], scales: list[float]) -> Tensor:
        """Latents of the picture, drawn at one scale."""
        latents = [self.codec.encode(video) for video in videos]
        weighed = [z if scale == 1 else scale * z for scale, z in zip(scales, latents)]
        mean = torch.stack(weighed).mean(0)
        fused = torch.cat(weighed, 1) if self.config.fusion == "concat" else mean
        t = None if self.config.sigma is None else self.config.sigma / (1 + self.config.sigma)
        if t is None:
            change = self.backbone(fused, PLAIN_TIMESTEP)
        else:
            change = -t * self.backbone((1 - t) * fused, t).float()
        change, kernels, shares, wide = change.split(self._predicted, 1)
        if self.config.skip == MEAN:
            start = mean
        elif self.config.skip_kernel:
            start = self._refiltered(videos, kernels, shares, wide)
        else:
            index = self.config.guidance.index(self.config.skip)
            start = self._blurred(videos[index]) if self.config.skip_blur else latents[index]
        # The difference of two nearly equal numbers in bf16 would lose the picture: in float32 there.
        return start + change if t is None else (1 - t) * start.float() + change

    def check_weights(self, weights: Mapping[str, float] | None) -> None:
        """As Renderer.check_weights: one number >= 0 for each buffer of the guidance, not all of them 0."""
        if weights is not None:
            try:
                check_weights(weights, self.config.guidance)
            except ValueError as error:
                raise TronError(str(error)) from error

    def hidden_matrices(self) -> list[nn.Parameter]:
        """Weights between hidden layers, 2-D, of the backbone."""
        return self.backbone.hidden_matrices()

    def temporal_weights(self) -> dict[str, nn.Parameter]:
        """As Renderer.temporal_weights: the backbone's."""
        return {f"backbone.{name}": p for name, p in self.backbone.temporal_weights().items()}

    def calibrate(self, videos: Iterable[Tensor]) -> None:
        """Calibrate the codec."""
        self.codec.calibrate(videos)

    def _scales(self, weights: Mapping[str, float] | None) -> list[float]:
        """Factors of the latents: weight times number, so that equal weights are factors of exactly 1."""
        weights = self.config.weights if weights is None else weights
        guidance = self.config.guidance
        if weights is None:
            return [1.0] * len(guidance)
        if any(weights.values()) or set(weights) != set(guidance):
            self.check_weights(weights)
        return [len(guidance) * weights[name] for name in guidance]

    def _blurred(self, video: Tensor) -> Tensor:
        """Latents of the start, filtered by the Gaussian."""
        blur = gaussian_logits(self.config.skip_blur, BLUR_SIDE).to(video)
        return self.codec.encode(filtered(video, blur.softmax(0)))

    def _refiltered(self, videos: list[Tensor], kernels: Tensor, shares: Tensor, wide: Tensor) -> Tensor:
        """The start, filtered by kernels that the backbone changes the Gaussian to, and detail given back."""
        names, config = self.config.guidance, self.config
        start = videos[names.index(config.skip)]
        sharp = start[:, :0] if config.skip_detail is None else videos[names.index(config.skip_detail)]
        blur = gaussian_logits(config.skip_blur, config.skip_kernel).to(start)
        both = filtered(torch.cat([start, sharp], 1), (blur[:, None, None, None] + kernels).softmax(1))
        if config.skip_holes:
            alone = torch.full((config.skip_kernel**2,), HARDLY).to(start)
            alone[len(alone) // 2] = 0
            weights = (alone[:, None, None, None] + wide).softmax(1)
            both = filtered(both, weights, 1 + config.skip_holes)
        smooth, blunt = both.split([start.shape[1], sharp.shape[1]], 1)
        return smooth if config.skip_detail is None else smooth + shares * (sharp - blunt)

    def _padded(self, video: Tensor) -> Tensor:
        block = self.codec.space_block
        below, right = -video.shape[-2] % block, -video.shape[-1] % block
        return pad(video, (0, right, 0, below, 0, 0), mode="replicate") if below or right else video


def to_tensor(display: np.ndarray) -> Tensor:
    """Display values (K, H, W, 3) in [0, 1] -> network input (1, 3, K, H, W) in [-1, 1].

    NaN becomes 0 and infinity the end of the range: one such value would blacken all that the network's
    reach covers.
    """
    finite = np.nan_to_num(np.asarray(display, np.float32), nan=0.0, posinf=1.0, neginf=0.0)
    video = torch.from_numpy(np.ascontiguousarray(finite))
    return video.permute(3, 0, 1, 2)[None] * 2 - 1


def to_display_array(video: Tensor) -> np.ndarray:
    """Network output (1, 3, K, H, W) -> display values (K, H, W, 3) in [0, 1], clipped, NumPy float32."""
    image = (video[0].float().clamp(-1, 1) + 1) / 2
    return np.ascontiguousarray(image.permute(1, 2, 3, 0).cpu().numpy())


def render_clip(
    renderer: Renderer,
    displayed: Mapping[str, np.ndarray],
    window: int | None = None,
    overlap: Overlap = "anchor",
    weights: Mapping[str, float] | None = None,
    motion: Motion | None = None,
) -> np.ndarray:
    """Render a clip of any length.

    Args:
        renderer: what renders.
        displayed: its guidance by name, (K, H, W, 3) display values in [0, 1], as `Clip.displayed` gives.
        window: frames a pass, 1 + temporal_factor * n (default: the renderer's own).
        overlap: which of the windows that hold a frame draws it, see `tron.neural.clips`.
        weights: of the latents by name, instead of the renderer's own.
        motion: of the clip's surfaces, as `surface_motion` tells it: each frame is then averaged with as many
            others as a window has, brought to it (`tron.neural.clips`). None: windows alone.

    Returns:
        Display values (K, H, W, 3) in [0, 1], float32.

    Raises:
        TronError: the buffers are no clip, or window, overlap or weights do not fit the renderer.
    """
    shapes = {buffer.shape for buffer in displayed.values()}
    if len(shapes) != 1 or any(len(shape) != 4 or shape[-1] != 3 or not shape[0] for shape in shapes):
        given = " and ".join(str(shape) for shape in sorted(shapes)) or "none"
        raise TronError(f"clip buffers of shapes {given}", mend="give (K, H, W, 3) alike")

    def read(index: int) -> dict[str, np.ndarray]:
        return {name: buffer[index] for name, buffer in displayed.items()}

    frames = next(iter(shapes))[0]
    drawn = render_frames(renderer, read, frames, window, overlap, weights)
    size = window or renderer.config.window
    if motion is not None and size > 1:
        drawn = averaged_frames(drawn, frames, size, motion, overlap)
    return np.stack(list(drawn))


def render_frames(
    renderer: Renderer,
    read: Callable[[int], Mapping[str, np.ndarray]],
    frames: int,
    window: int | None = None,
    overlap: Overlap = "anchor",
    weights: Mapping[str, float] | None = None,
) -> Iterator[np.ndarray]:
    """Render a clip frame by frame, in the memory of one window, however long the clip is.

    Args:
        renderer: what renders; it stays in evaluation until the last frame was taken.
        read: gives the guidance of a frame by name, each (H, W, 3) display values; called once a frame, in
            order.
        frames: of the clip.
        window: as render_clip has it.
        overlap: likewise.
        weights: likewise.

    Yields:
        Display values (H, W, 3) in [0, 1], float32, in order.

    Raises:
        TronError: as render_clip.
    """
    size = window or renderer.config.window
    check_frames(size, renderer.temporal_factor)
    renderer.check_weights(weights)
    passes = windows(frames, size, renderer.temporal_factor, overlap)
    device = next(renderer.parameters()).device
    given: dict[int, dict[str, Tensor]] = {}
    unknown: Counter[str] = Counter()
    sums: dict[int, np.ndarray] = {}
    counts: dict[int, int] = {}
    was_training = renderer.training
    renderer.eval()
    try:
        for this, following in zip(passes, [*passes[1:], None]):
            for index in [index for index in given if index < this.frames.start]:
                del given[index]
            for index in [index for index in this.frames if index not in given]:
                shown = read(index)
                wanted = [name for name in renderer.config.guidance if name in shown]
                unknown.update({name: int((~np.isfinite(shown[name])).sum()) for name in wanted})
                given[index] = {name: to_tensor(shown[name][None]).to(device) for name in wanted}
            with torch.no_grad():
                drawn = drawn_in_tiles(renderer, _joined([given[index] for index in this.frames]), weights)
            display = to_display_array(drawn)
            for index in this.kept:
                frame = display[index - this.frames.start]
                sums[index] = sums[index] + frame if index in sums else frame
                counts[index] = counts.get(index, 0) + 1
            # A frame is finished where no later window keeps it.
            for index in sorted(i for i in sums if following is None or i < following.kept.start):
                yield sums.pop(index) / np.float32(counts.pop(index))
    finally:
        renderer.train(was_training)
        for name, count in (+unknown).items():
            log.warning(
                "%d values of %s are NaN or infinite: the network is given 0 for NaN, 0 or 1 for infinity",
                count, name,
            )  # fmt: skip


def _joined(frames: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Frames (1, 3, 1, H, W) by name, one after another: (1, 3, K, H, W)."""
    return {name: torch.cat([frame[name] for frame in frames], 2) for name in frames[0]}


def drawn_in_tiles(
    renderer: Renderer,
    buffers: Mapping[str, Tensor],
    weights: Mapping[str, float] | None = None,
    side: int = TILE,
) -> Tensor:
    """Run :meth:`Renderer.forward` on frames (B, 3, K, H, W), in tiles if frames are larger than a tile.

    A pixel depends on those within the network's reach. Tiles begin at multiples of its stride and are given
    the reach as margin, so that they draw what one pass over the whole draws; the shipped ones within 1/255.

    Args:
        side: of a tile, pixels, brought up to the network's stride. Networks that look at the whole picture
            (``renderer.reach`` is None) draw it whole.
    """
    height, width = next(iter(buffers.values())).shape[-2:]
    reach, stride = renderer.reach, renderer.stride
    if reach is None or max(height, width) <= side + reach:
        return renderer(buffers, weights)
    side, margin = (-(-pixels // stride) * stride for pixels in (side, reach))
    drawn: list[Tensor] = []
    for rows, seen_rows in _spans(height, side, margin):
        across = []
        for columns, seen_columns in _spans(width, side, margin):
            seen = {name: buffer[..., seen_rows, seen_columns] for name, buffer in buffers.items()}
            top, left = rows.start - seen_rows.start, columns.start - seen_columns.start
            tall, wide = rows.stop - rows.start, columns.stop - columns.start
            across.append(renderer(seen, weights)[..., top : top + tall, left : left + wide])
        drawn.append(torch.cat(across, -1))
    return torch.cat(drawn, -2)


def _spans(length: int, side: int, margin: int) -> Iterator[tuple[slice, slice]]:
    """Of each tile along one axis: the pixels that it draws, and those that it sees."""
    for start in range(0, length, side):
        stop = min(start + side, length)
        yield slice(start, stop), slice(max(start - margin, 0), min(stop + margin, length))
