"""Maps of what surfaces are, on a sphere above a plane that is traced in closed form."""

from dataclasses import replace

import numpy as np

from tron.estimation import FINAL, FINEST, MOST_RAYS, OCTAVES
from tron.shading.guidance import surface_maps
from tron.shards.schema import surface_members


def test_maps_are_materials_and_slope_inside_surfaces_and_nothing_outside(
    variant: str, sphere_over_plane, camera
) -> None:
    maps = surface_maps(sphere_over_plane(base_color=0.6, metallic=0.25), camera, [FINAL])[0]
    assert {name: image.shape for name, image in maps.items()} == dict.fromkeys(
        surface_members(), (48, 48, 3)
    )
    covered = maps["albedo"][..., 0] / 0.6
    inside, outside = covered > 0.999, covered == 0
    assert inside.sum() > 500
    assert outside.sum() > 100
    np.testing.assert_allclose(maps["surface"][inside][:, 1:], [[0.5, 0.25]] * inside.sum(), atol=1e-5)
    assert not maps["surface"][outside].any()


def test_slope_is_the_cosine_of_normal_and_view(variant: str, sphere_over_plane, camera) -> None:
    """On the plane z = 0 it is -z of the ray, averaged over the four sub-pixels."""
    slope = surface_maps(sphere_over_plane(sphere=False), camera, [FINAL])[0]["surface"][..., 0]
    rays = camera.resized(96, 96).rays()[..., 2].reshape(48, 2, 48, 2).mean((1, 3))
    inside = surface_maps(sphere_over_plane(sphere=False), camera, [FINAL])[0]["albedo"][..., 0] > 0.999
    np.testing.assert_allclose(slope[inside], -rays[inside], atol=1e-5)


def test_a_pixel_at_an_edge_has_the_share_that_is_covered(variant: str, sphere_over_plane, camera) -> None:
    covered = surface_maps(sphere_over_plane(), camera, [FINAL])[0]["albedo"][..., 0]
    shares = np.unique(covered.round(4))
    assert set(shares) == {0.0, 0.25, 0.5, 0.75, 1.0}


def test_surfels_count_by_their_opacity(variant: str, sphere_over_plane, camera) -> None:
    class Thin(sphere_over_plane):
        def gbuffer(self, camera):
            seen = super().gbuffer(camera)
            return replace(seen, opacity=0.25 * seen.opacity)

    thin, solid = (surface_maps(each(), camera, [FINAL])[0] for each in (Thin, sphere_over_plane))
    for name in ("albedo", "surface"):
        np.testing.assert_allclose(thin[name], 0.25 * solid[name], atol=1e-6)
    np.testing.assert_array_equal(thin["sampling"][..., :2], solid["sampling"][..., :2])
    beyond = 1 - solid["sampling"][..., 2]  # 1 is nothing there
    np.testing.assert_allclose(1 - thin["sampling"][..., 2], 0.25 * beyond, atol=1e-6)


def test_sampling_tells_rays_and_footprints(variant: str, sphere_over_plane, camera) -> None:
    """On the plane z = 0 the distance is height / -z of the ray; twice the picture is an octave less."""
    plane = sphere_over_plane(sphere=False)
    plain, finest = (maps["sampling"] for maps in surface_maps(plane, camera, [FINAL, FINEST]))
    inside = surface_maps(plane, camera, [FINAL])[0]["albedo"][..., 0] > 0.999
    np.testing.assert_allclose(plain[inside][:, :2], [[0, 6 / MOST_RAYS]] * inside.sum(), atol=1e-6)
    np.testing.assert_allclose(finest[inside][:, :2], [[1, 6 / MOST_RAYS]] * inside.sum(), atol=1e-6)
    distance = camera.position[2] / -camera.rays()[..., 2]
    octaves = np.log2(distance / camera.fx / plane.scene.spacing)
    low, high = OCTAVES
    np.testing.assert_allclose(plain[inside][:, 2], ((octaves - low) / (high - low))[inside], atol=2e-3)
    larger = camera.resized(2 * camera.width, 2 * camera.height)
    finer = surface_maps(plane, larger, [FINAL])[0]["sampling"][..., 2].reshape(48, 2, 48, 2).mean((1, 3))
    middle = np.zeros_like(inside)
    middle[20:28, 20:28] = inside[20:28, 20:28]
    assert middle.any()
    np.testing.assert_allclose((plain[..., 2] - finer)[middle], 1 / (high - low), atol=2e-3)
