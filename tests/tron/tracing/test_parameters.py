"""Laws of packing: gradients through it add to whatever else a loss asks of the parameters."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tron import seeds
from tron.gaussians.fields import PARAMETERS
from tron.tracing.parameters import SurfelParameters, pack

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("first", ["records", "penalty"])
def test_gradients_add_to_those_of_a_regulariser(random_scene, first: str) -> None:
    scene = random_scene(20)
    rng = seeds.generator(0, "tests", "packing")

    def gradients(with_records: bool, with_penalty: bool) -> dict[str, np.ndarray]:
        parameters = SurfelParameters.from_scene(scene)
        for name in PARAMETERS:
            dr.enable_grad(getattr(parameters, name))

        def penalty() -> mi.Float:
            return dr.sum([dr.sum(dr.square(getattr(parameters, name))) for name in PARAMETERS])

        total = penalty() if with_penalty and first == "penalty" else mi.Float(0)
        if with_records:
            records = pack(parameters)
            for name, values in weights.items():
                total += dr.sum(mi.Float(values) * getattr(records, name))
        total += penalty() if with_penalty and first != "penalty" else mi.Float(0)
        dr.backward(total)
        return {name: np.array(dr.grad(getattr(parameters, name))) for name in PARAMETERS}

    records = pack(SurfelParameters.from_scene(scene))
    weights = {
        name: rng.normal(size=dr.width(getattr(records, name))).astype(np.float32)
        for name in ("geometry", "features", "harmonics")
    }
    both, one, other = gradients(True, True), gradients(True, False), gradients(False, True)
    for name in PARAMETERS:
        assert np.abs(one[name]).max() > 0.01
        np.testing.assert_allclose(both[name], one[name] + other[name], rtol=1e-4, atol=1e-4, err_msg=name)
