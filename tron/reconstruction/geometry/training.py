"""The optimisation loop of stages 1 and 2: one view per step, Adam, density control, a guard against NaN.

A run is a function of its settings, its seed and the step: views come in a random order, drawn again once all
have been seen. So a run resumed from a checkpoint repeats the uninterrupted one, bit by bit with one Dr.Jit
and one torch thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Literal

import numpy as np
import torch
from cachetools import LRUCache
from torch import Tensor

from tron.captures import View
from tron.captures.view import ToneCurve
from tron.errors import TronError
from tron.reconstruction.geometry.fused_normals import FusedNormals
from tron.reconstruction.geometry.losses import MATERIALS, Weights, loss_of, pictures, targets
from tron.reconstruction.geometry.photo_exposure import PhotoExposures
from tron.reconstruction.geometry.surfels import LearntSurfels
from tron.reconstruction.settings import (
    ConsistencySettings,
    DensitySettings,
    MaterialSettings,
    RadianceSettings,
)
from tron.seeds import generator
from tron.tracing.torch_bridge import render

Background = Literal["black", "white", "random"]
_PSNR_MEMORY = 0.98
_EXPOSURES_FROM = 0.1
# Of "3D Gaussian Splatting" (Kerbl et al. 2023): scale over the extent up to which surfels are cloned, larger
# ones are split; divisor of split ones' scales; opacity that others are pruned below; opacity after a reset.
_CLONE_BELOW, _SPLIT_SHRINK, _PRUNE_BELOW, _RESET_TO = 0.01, 1.6, 0.005, 0.01
# Of views cached on a GPU, at most a quarter of its free memory: reading, checking and reducing views on the
# host at each step would leave the GPU idle.
_KEPT_ON_DEVICE = 8 << 30


@dataclass(frozen=True)
class StepSummary:
    """State of a stage after a step.

    Attributes:
        stage: its name.
        step: steps done.
        steps: in all.
        loss: of the step.
        psnr: of recent steps' pictures, dB, NaN where the stage compares none.
        surfels: their number.
        seconds: wall time of the step.
    """

    stage: str
    step: int
    steps: int
    loss: float
    psnr: float
    surfels: int
    seconds: float


Watch = Callable[[StepSummary, "Stage"], None]
"""Called after every step: to show progress, to write checkpoints, to measure."""


@dataclass(frozen=True)
class Plan:
    """Settings of one stage for the loop.

    Attributes:
        name: of the stage; part of the seeds' paths.
        steps: how many.
        weights: of the maps in the loss.
        rates: Adam's rates of the learnt parameters.
        final_rates: rates at the last step, reached log-linearly; the others stay.
        sh_degree: highest degree of the harmonics.
        sh_every: steps after which one more degree is learnt.
        background: behind the surfels.
        density: adds and removes surfels; None keeps their number.
        exposures: tone curve of photos whose exposures are estimated; None: all have one exposure.
        consistency: pulls normals to the fused normals of the views' depths; None: no pull.
        coarse: shares of the steps on photos reduced by powers of two down to 2, smallest photos first.
        window: side in pixels of the square window of a view, at a random place, that a step compares; views
            that are no larger are compared whole. None: all are. Not with consistency, whose maps are whole.
    """

    name: str
    steps: int
    weights: Weights
    rates: dict[str, float]
    final_rates: Mapping[str, float] = field(default_factory=dict)
    sh_degree: int = 0
    sh_every: int = 1
    background: Background = "black"
    density: DensityControl | None = None
    exposures: ToneCurve | None = None
    consistency: ConsistencySettings | None = None
    coarse: tuple[float, ...] = ()
    window: int | None = None

    def smaller(self, step: int) -> int:
        """Reduction factor of the photos in step ``step`` (from 0)."""
        ends = [round(share * self.steps) for share in accumulate(self.coarse)]
        return 1 << sum(step < end for end in ends)

    def learning(self, names: Collection[str]) -> Plan:
        """The same plan, learning only these parameters."""
        kept = {name: rate for name, rate in self.rates.items() if name in names}
        final = {name: rate for name, rate in self.final_rates.items() if name in names}
        return replace(self, rates=kept, final_rates=final)


def radiance_plan(
    settings: RadianceSettings,
    extent: float,
    seed: int,
    *,
    normals_given: bool = False,
    tone_curve: ToneCurve = "srgb",
) -> Plan:
    """Stage 1: geometry and radiance; ``extent`` in world units scales the rate of the positions.

    Normals are pulled to those that the views' depths agree on unless a prior gives some (``normals_given``);
    ``tone_curve`` is that of the photos.
    """
    own = settings.consistency.weight if not normals_given else 0.0
    rates = {
        "means": settings.position_rate * extent,
        "quats": settings.rotation_rate,
        "log_scales": settings.scale_rate,
        "opacity_logits": settings.opacity_rate,
        "sh_dc": settings.sh_rate,
    }
    if settings.sh_degree > 0:
        rates["sh_rest"] = settings.sh_rest_rate
    return Plan(
        name="radiance",
        steps=settings.steps,
        weights=Weights(
            rgb=1.0, normal=settings.normal, mask=settings.mask, ssim=settings.ssim, consistency=own
        ),
        rates=rates,
        final_rates={"means": settings.position_rate_final * extent},
        sh_degree=settings.sh_degree,
        sh_every=settings.sh_every,
        background=settings.background,
        density=DensityControl(settings.density, extent, seed),
        exposures=tone_curve if settings.exposures else None,
        consistency=settings.consistency if own else None,
        coarse=settings.coarse,
    )


def materials_plan(settings: MaterialSettings) -> Plan:
    """Stage 2: base color, roughness and metallic on frozen geometry."""
    return Plan(
        name="materials",
        steps=settings.steps,
        weights=Weights(base_color=1.0, roughness=1.0, metallic=1.0, ssim=settings.ssim),
        rates=dict.fromkeys(MATERIALS, settings.rate),
        final_rates=dict.fromkeys(MATERIALS, settings.decay * settings.rate),
    )


class Stage:
    """One stage under way.

    Args:
        plan: its settings.
        views: training views.
        surfels: the learnt surfels, changed in place.
        kernel_degree: of the surfels.
        seed: root of every random number.

    Raises:
        TronError: no views.
    """

    def __init__(
        self, plan: Plan, views: Sequence[View], surfels: LearntSurfels, kernel_degree: int, seed: int
    ) -> None:
        if not views:
            raise TronError("there is no view to learn from")
        self.plan, self.views, self.surfels = plan, views, surfels
        self.kernel_degree, self.seed = kernel_degree, seed
        self.step = 0
        self.psnr = float("nan")
        self.exposures: PhotoExposures | None = None
        if plan.exposures is not None:
            self.exposures = PhotoExposures(views, plan.exposures, round(_EXPOSURES_FROM * plan.steps))
        self.fused: FusedNormals | None = None
        if plan.consistency is not None:
            self.fused = FusedNormals(plan.consistency, kernel_degree)
        self._reduced: tuple[int, Sequence[View]] = (1, views)
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, int))
        kept = 0
        if torch.device(surfels.device).type == "cuda" and plan.window is None:
            kept = min(_KEPT_ON_DEVICE, torch.cuda.mem_get_info()[0] // 4)
        self._targets: LRUCache[View, dict[str, Tensor]] = LRUCache(kept, getsizeof=_n_bytes)

    def run(self, watch: Watch | None = None) -> None:
        """Take the remaining steps.

        Raises:
            TronError: a parameter or the loss is no longer finite; it names the step and the parameter.
        """
        while self.step < self.plan.steps:
            progress = self.advance()
            if watch is not None:
                watch(progress, self)

    def advance(self) -> StepSummary:
        """Take one step."""
        began = time.perf_counter()
        plan, surfels, number = self.plan, self.surfels, self.step + 1
        view = self._view(self.step)
        target = self._target(view)
        if self.fused is not None:
            if self.step % self.fused.settings.every == 0 or self._resized():
                self.fused.make(surfels, self.pictured())
            target |= self.fused.of(view)
        self._set_rates()
        rendered = render(
            surfels.rendered(), view.camera, kernel_degree=self.kernel_degree, sh_degree=self.sh_degree
        )
        background = self._background()
        if self.exposures is not None:
            stored, target = target, self.exposures.balanced(view, target)
            self.exposures.observe(view, self.step, rendered, stored)
        loss = loss_of(rendered, target, plan.weights, background)
        if not loss.requires_grad:
            raise TronError(
                f"stage {plan.name} has nothing to learn from view {view.name}",
                mend="give it maps or an image",
            )
        surfels.clear_gradients()
        loss.backward()
        value = float(loss.detach())
        self._guard(value, view)
        if plan.density is not None:
            camera = torch.tensor(view.camera.position, dtype=torch.float32, device=surfels.device)
            plan.density.observe(surfels, camera)
        surfels.step()
        if plan.density is not None:
            plan.density.after(surfels, number, plan.smaller(self.step))
        self.step = number
        self._remember(rendered, target, background)
        seconds = time.perf_counter() - began
        return StepSummary(plan.name, number, plan.steps, value, self.psnr, len(surfels), seconds)

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics that the next step learns."""
        return min(self.step // self.plan.sh_every, self.plan.sh_degree)

    def pictured(self) -> Sequence[View]:
        """The views at the plan's size for the next step."""
        times = self.plan.smaller(self.step)
        if times != self._reduced[0]:
            self._reduced = (times, [view.reduced(times) for view in self.views])
        return self._reduced[1]

    def _resized(self) -> bool:
        """Whether the next step is the first one of its size."""
        return self.step > 0 and self.plan.smaller(self.step) != self.plan.smaller(self.step - 1)

    def _view(self, step: int) -> View:
        """Views in random order, each once before any comes again."""
        epoch, place = divmod(step, len(self.views))
        if self._order[0] != epoch:
            order = generator(self.seed, self.plan.name, "views", epoch).permutation(len(self.views))
            self._order = (epoch, order)
        view = self.pictured()[self._order[1][place]]
        return view if self.plan.window is None else self._window(view, self.plan.window, step)

    def _target(self, view: View) -> dict[str, Tensor]:
        """The view's target maps, cached from recent steps."""
        found = self._targets.get(view)
        if found is None:
            found = targets(view, self.plan.weights.wanted(), self.surfels.device)
            if _n_bytes(found) <= self._targets.maxsize:
                self._targets[view] = found
        return dict(found)

    def _window(self, view: View, side: int, step: int) -> View:
        sides = (view.camera.width, view.camera.height)
        free = np.maximum(np.array(sides) - side, 0)
        x, y = generator(self.seed, self.plan.name, "window", step).integers(0, free + 1).tolist()
        return view.window(x, y, min(side, sides[0]), min(side, sides[1]))

    def _background(self) -> np.ndarray:
        if self.plan.background == "random":
            return generator(self.seed, self.plan.name, "background", self.step).random(3)
        return np.full(3, 1.0 if self.plan.background == "white" else 0.0)

    def _set_rates(self) -> None:
        done = self.step / max(self.plan.steps - 1, 1)
        for name, final in self.plan.final_rates.items():
            first = self.plan.rates[name]
            self.surfels.set_rate(name, first * (final / first) ** done)

    def _guard(self, loss: float, view: View) -> None:
        """Refuse what is not finite before any parameter is changed.

        The cause is named before its effects: parameters (surfels whose place is NaN are hit by no ray and
        spoil no loss), gradients, the loss.
        """
        found = {name: self.surfels[name].detach() for name in self.plan.rates}
        gradients = {f"gradient of {name}": self.surfels[name].grad for name in self.plan.rates}
        found |= {name: gradient for name, gradient in gradients.items() if gradient is not None}
        # One number tells of all: a sum is not finite if any term is not.
        if not np.isfinite(loss + float(sum(values.sum() for values in found.values()))):
            for name, values in found.items():
                if not bool(torch.isfinite(values).all()):
                    raise self._not_finite(name, view)
            if not np.isfinite(loss):
                raise self._not_finite("loss", view)

    def _not_finite(self, what: str, view: View) -> TronError:
        return TronError(
            f"{what} is not finite at step {self.step + 1} of stage {self.plan.name}",
            f"view {view.name}",
            "lower the learning rates, or go on from the last checkpoint with another seed",
        )

    def _remember(
        self, rendered: dict[str, Tensor], target: dict[str, Tensor], background: np.ndarray
    ) -> None:
        """Running mean of the squared error of the pictures, as PSNR."""
        if not self.plan.weights.rgb or "image" not in target:
            return
        with torch.no_grad():
            picture, wanted = pictures(rendered, target, background)
            now = -10 * float(torch.log10(((picture - wanted) ** 2).mean().clamp(min=1e-12)))
        before = self.psnr
        self.psnr = now if np.isnan(before) else _PSNR_MEMORY * before + (1 - _PSNR_MEMORY) * now


class DensityControl:
    """Adds surfels where positions are pulled hard and removes transparent ones as training goes.

    From "3D Gaussian Splatting" (Kerbl et al. 2023), with the gradient of the 3D position that 3DGRT uses in
    place of the screen's ("3D Gaussian Ray Tracing", Moenne-Loccoz et al. 2024): a surfel is cloned or split
    where the mean of |d loss / d position| x distance to the camera / 2, over the steps that saw it, exceeds
    a threshold.

    Args:
        settings: when and how.
        extent: size of the capture, world units.
        seed: root of the splits' samples.
    """

    def __init__(self, settings: DensitySettings, extent: float, seed: int) -> None:
        self.settings, self.extent, self.seed = settings, extent, seed
        self.total = self.seen = torch.zeros(0)

    def observe(self, surfels: LearntSurfels, camera: Tensor) -> None:
        """Accumulate the gradients of one step seen from ``camera``, (3,), world."""
        if len(self.total) != len(surfels):
            self.forget(surfels)
        means = surfels["means"]
        if means.grad is None:
            return
        pull = means.grad.norm(dim=1)
        self.total += pull * (means.detach() - camera).norm(dim=1) / 2
        self.seen += pull > 0

    def forget(self, surfels: LearntSurfels) -> None:
        """Reset the running mean."""
        self.total = torch.zeros(len(surfels), device=surfels.device)
        self.seen = torch.zeros(len(surfels), device=surfels.device)

    def after(self, surfels: LearntSurfels, step: int, smaller: int = 1) -> None:
        """Add, remove and reset surfels as is due once ``step`` (from 1) is done.

        Photos reduced by the factor ``smaller`` allow that many times fewer surfels.
        """
        s = self.settings
        if s.start < step < s.end and step % s.every == 0:
            self._add(surfels, step, s.most // smaller)
        if step % s.prune_every == 0 and step < s.end:
            self._prune(surfels)
        if s.reset_every and step < s.end and step % s.reset_every == 0:
            most = torch.logit(torch.tensor(_RESET_TO, device=surfels.device))
            surfels.replace("opacity_logits", surfels["opacity_logits"].detach().clamp(max=most))

    def _prune(self, surfels: LearntSurfels) -> None:
        kept = torch.sigmoid(surfels["opacity_logits"].detach()) >= _PRUNE_BELOW
        if kept.all():
            return
        surfels.select(kept)
        if len(self.total) == len(kept):
            self.total, self.seen = self.total[kept], self.seen[kept]

    def _add(self, surfels: LearntSurfels, step: int, most: int) -> None:
        s = self.settings
        pull = self.total / self.seen.clamp(min=1)
        capacity = max(most - len(surfels), 0)
        chosen = torch.nonzero(pull > s.threshold)[:, 0]
        if len(chosen) > capacity:  # a clone and a split both add one
            chosen = chosen[torch.topk(pull[chosen], capacity, sorted=False).indices].sort().values
        if len(chosen):
            scale = surfels["log_scales"].detach()[chosen].exp().amax(dim=1)
            small = scale <= _CLONE_BELOW * self.extent
            clones = {name: values.detach()[chosen[small]] for name, values in surfels.tensors.items()}
            halves = self._halves(surfels, chosen[~small], step)
            kept = torch.ones(len(surfels), dtype=torch.bool, device=surfels.device)
            kept[chosen[~small]] = False
            added = {name: torch.cat([clones[name], halves[name]]) for name in clones}
            # Surfels are added before those that they replace go, so that there is always one.
            surfels.append(added)
            surfels.select(torch.cat([kept, kept.new_ones(len(added["means"]))]))
        self.forget(surfels)

    def _halves(self, surfels: LearntSurfels, chosen: Tensor, step: int) -> dict[str, Tensor]:
        """Two smaller surfels for each one chosen, at points drawn from it in its plane."""
        rows = {
            name: values.detach()[chosen].repeat_interleave(2, dim=0)
            for name, values in surfels.tensors.items()
        }
        draw = generator(self.seed, "density", "split", step).standard_normal((len(chosen) * 2, 2))
        place = torch.tensor(draw, dtype=torch.float32, device=surfels.device) * rows["log_scales"].exp()
        tangent_u, tangent_v = _tangents(rows["quats"])
        rows["means"] = rows["means"] + place[:, :1] * tangent_u + place[:, 1:] * tangent_v
        rows["log_scales"] = rows["log_scales"] - torch.log(torch.tensor(_SPLIT_SHRINK))
        return rows

    def state(self) -> dict[str, Tensor]:
        """The running means, for a checkpoint."""
        return {"density.total": self.total, "density.seen": self.seen}

    def restore(self, stored: dict[str, Tensor], device: torch.device) -> None:
        """Inverse of :meth:`state`."""
        self.total, self.seen = (stored[f"density.{name}"].to(device) for name in ("total", "seen"))


def _n_bytes(maps: dict[str, Tensor]) -> int:
    return sum(values.nbytes for values in maps.values())


def _tangents(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Tangents u and v, (M, 3) each, world, of quaternions (w, x, y, z) of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    u = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=1)
    v = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=1)
    return u, v
