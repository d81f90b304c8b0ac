"""The catalogue: nothing without a licence unless it is allowed by name."""

import json

import numpy as np
import pytest

from datagen.files.assets import find_assets, find_environments, require_licences
from datagen.settings.command import Settings
from tron.cli.recipes import check, compose_recipe
from tron.errors import TronError
from tron.shading.environments.environment import EnvironmentMap
from tron.storage import sha256

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "sub").mkdir()
    for name in ("a.obj", "sub/b.obj", "sub/a.obj"):
        (tmp_path / name).write_text(TRIANGLE)
    return tmp_path


def catalogue(folder, *paths, name="catalogue.json"):
    entries = [{"path": p, "licence": "CC0-1.0", "author": "me", "source": "here"} for p in paths]
    (folder / name).write_text(json.dumps(entries))
    return folder / name


def test_licensed_files_are_listed_in_order_with_their_hash(folder):
    catalogue(folder, "a.obj", "sub/b.obj", "sub/a.obj")
    assets = find_assets(folder)
    assert [asset.path for asset in assets] == ["a.obj", "sub/a.obj", "sub/b.obj"]
    assert [asset.id for asset in assets] == ["a", "sub/a", "b"], "colliding stems go by their path"
    assert assets[0].sha256 == sha256(folder / "a.obj")
    assert assets[0].licence == "CC0-1.0"


def test_a_file_without_licence_is_refused_by_name(folder):
    catalogue(folder, "a.obj", "sub/a.obj")
    with pytest.raises(TronError, match=r"'b' has no licence.*allow_unlicensed=\[b\]"):
        find_assets(folder)
    allowed = find_assets(folder, allow_unlicensed=["b"])
    assert {asset.id: asset.licence for asset in allowed}["b"] is None


def test_all_files_without_licence_are_named_in_one_line_and_allowed_at_once(folder):
    with pytest.raises(TronError, match=r"3 assets have no licence: a, sub/a, b.*allow_unlicensed=all"):
        find_assets(folder)
    with pytest.raises(TronError, match=r"2 assets have no licence: a, sub/a \("):
        find_assets(folder, allow_unlicensed=["b"])
    assert len(find_assets(folder, allow_unlicensed="all")) == 3
    for name in ("l", "al"):  # no file is allowed because its name is part of the word
        with pytest.raises(TronError, match="no licence"):
            require_licences("asset", folder, {name: "a.obj"}, ["all"])
    with pytest.raises(TronError, match=r"5000 assets have no licence: n0, .* n19 and 4980 more"):
        require_licences("asset", folder, {f"n{k}": "x" for k in range(5000)}, ())


def test_assets_are_chosen_by_name_and_the_others_need_no_licence(folder):
    catalogue(folder, "sub/b.obj")
    assert [asset.path for asset in find_assets(folder, names=["b"])] == ["sub/b.obj"]
    with pytest.raises(TronError, match=r"no asset 'c'.*there are a, sub/a, b"):
        find_assets(folder, names=["b", "c"])


def test_a_catalogue_may_lie_elsewhere(folder, tmp_path_factory):
    elsewhere = catalogue(tmp_path_factory.mktemp("c"), "a.obj", "sub/a.obj", "sub/b.obj", name="mine.json")
    assert len(find_assets(folder, catalogue=elsewhere)) == 3


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", '[{"licence": "x"}]', '[{"path": "a", "wrong": 1}]', "[" * 100_000, "\x00"]
)
def test_damaged_catalogues_are_one_line_errors(folder, text):
    (folder / "catalogue.json").write_text(text)
    with pytest.raises(TronError, match="catalogue cannot be read") as caught:
        find_assets(folder)
    assert "\n" not in str(caught.value)


def test_missing_and_empty_folders_are_errors(tmp_path):
    with pytest.raises(TronError, match="not found"):
        find_assets(tmp_path / "none")
    with pytest.raises(TronError, match=r"no \.gltf"):
        find_assets(tmp_path)


def test_environment_maps_are_classified_by_what_they_hold(tmp_path, variant):
    flat = np.full((16, 32, 3), 0.5, np.float32)
    lamp = flat.copy()
    lamp[5, 7] = 500.0
    EnvironmentMap(flat).save(tmp_path / "flat.exr")
    EnvironmentMap(lamp).save(tmp_path / "lamp.hdr")
    catalogue(tmp_path, "flat.exr", "lamp.hdr")
    _, specs = find_environments(tmp_path)
    assert [(spec.path, spec.contrast) for spec in specs] == [("flat.exr", "low"), ("lamp.hdr", "high")]


@pytest.mark.parametrize(
    "told, lights",
    [
        ([], ["sun", "studio", "overcast"]),
        (["environments=maps"], ["any"] * 3),
        (["environments=maps", "test.lights=[sun,studio,overcast]"], ["sun", "studio", "overcast"]),
        (["environments=maps", "test.width=32"], ["any"] * 3),
    ],
)
def test_the_test_lights_are_the_users_where_he_gave_some(told: list[str], lights: list[str]):
    settings = check(compose_recipe("conf.datagen", Settings, [*told, "output_dir=out"]), Settings)
    assert settings.split("test").lights == settings.recipe()["test"]["lights"] == lights
    assert settings.light_families() == (["hdri"] if "environments=maps" in told else None)


def test_other_splits_need_a_light():
    with pytest.raises(TronError, match=r"train.lights is empty"):
        check(compose_recipe("conf.datagen", Settings, ["train.lights=[]", "output_dir=out"]), Settings)
