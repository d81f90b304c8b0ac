"""The projection's law: it finds the terms it was made from, and counted memory is linear in tokens."""

import pytest

from eval.renderer.cosmos_cost import PAPER_SIZE, Shape, fit, measure_cosmos, transformer_activations
from tron.errors import TronError
from tron.neural.configs import BackboneConfig

SMALL = BackboneConfig(
    heads=2,
    head_dim=12,
    layers=6,
    adaln_lora_dim=8,
    patch=(1, 2, 2),
    padding_channel=True,
    max_size=(8, 240, 240),
)


def test_tokens_of_the_paper_s_clip():
    assert Shape(*PAPER_SIZE).tokens == 64 * 36 * 2
    assert Shape(256, 256).tokens == 256


def test_the_law_projects_what_follows_it():
    shapes = [Shape(size, size) for size in (64, 128, 192, 256)]
    seconds = [0.5 + 2e-3 * shape.tokens + 3e-7 * shape.tokens**2 for shape in shapes]
    far = Shape(*PAPER_SIZE)
    assert fit(shapes, seconds)(far) == pytest.approx(
        0.5 + 2e-3 * far.tokens + 3e-7 * far.tokens**2, rel=1e-6
    )
    with pytest.raises(ValueError, match="three"):
        fit(shapes[:2], seconds[:2])


def test_a_constant_pass_has_no_negative_terms():
    shapes = [Shape(size, size) for size in (64, 128, 192)]
    law = fit(shapes, [1.0, 1.02, 0.99])
    assert (law.coefficients >= 0).all()


def test_activations_are_linear_in_tokens_and_recomputing_saves_most_of_them():
    plain = {size: transformer_activations(SMALL, Shape(size, size), False, True) for size in (128, 256, 512)}
    assert plain[512] / plain[256] == pytest.approx(4, rel=0.1)
    checkpointed = transformer_activations(SMALL, Shape(512, 512), True, True)
    forward = transformer_activations(SMALL, Shape(512, 512), False, False)
    assert forward < checkpointed < plain[512] / 2


@pytest.mark.parametrize("sizes", [[(64, 64, 1)], [(64, 64, 1), (65, 64, 1), (96, 96, 1)]])
def test_sizes_that_do_not_make_a_law_are_refused(sizes):
    with pytest.raises(TronError):
        measure_cosmos(sizes)
