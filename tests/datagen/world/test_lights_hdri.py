"""The user's maps: what is no radiance is refused by name, before anything is made."""

import numpy as np
import pytest

from datagen.cli import cli
from datagen.files.assets import find_environments
from tron.errors import TronError
from tron.io.images import write_image
from tron.shading.environments.environment import EnvironmentMap

pytestmark = pytest.mark.usefixtures("variant")


def folder_with(path, value: float):
    """One good map and one with a bad value, in a folder of their own."""
    path.mkdir()
    image = np.full((16, 32, 3), 0.5, np.float32)
    EnvironmentMap(image).save(path / "good.exr")
    image[3, 4, 1] = value
    write_image(path / "spoilt.exr", image)
    return path


@pytest.mark.parametrize(("value", "said"), [(np.nan, "NaN"), (-np.inf, "negative"), (-900.0, "negative")])
def test_a_map_that_is_no_radiance_is_refused_by_name(tmp_path, value, said):
    folder = folder_with(tmp_path / "maps", value)
    with pytest.raises(TronError, match=said) as refused:
        find_environments(folder, allow_unlicensed=["good", "spoilt"])
    assert "spoilt.exr" in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("value", "instead"), [(np.inf, 0.5), (-0.5, 0.0)])
def test_a_map_with_a_spoilt_texel_is_mended_with_a_line(tmp_path, value, instead, caplog):
    folder = folder_with(tmp_path / "maps", value)
    _, found = find_environments(folder, allow_unlicensed=["good", "spoilt"])
    spoilt = next(each for each in found if each.path == "spoilt.exr").bake(16, folder)
    assert spoilt.image[3, 4, 1] == instead
    (line,) = (record.getMessage() for record in caplog.records)
    assert "1 of 512 texels" in line


def test_the_command_says_so_before_anything_is_made(tmp_path, capsys):
    folder = folder_with(tmp_path / "maps", np.nan)
    output = tmp_path / "out"
    told = ["train.scenes=1", "train_b.scenes=0", "validation.scenes=0", "test.scenes=0", "cluster=none"]
    told += [f"environments={folder}", "allow_unlicensed=[good,spoilt]", f"output_dir={output}"]
    with pytest.raises(SystemExit) as left:
        cli(told)
    assert left.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert "spoilt.exr" in error[-1]
    assert "NaN" in error[-1]
    assert not list(output.rglob("*.tar"))
    assert not list(output.rglob("spec.json"))
