"""The table of formats: what it is called by, and that users are told of all of it."""

from pathlib import Path
from typing import get_args

from tron.captures.load import FORMATS, CaptureSettings, load_capture


def test_format_takes_the_names_of_the_table() -> None:
    field = CaptureSettings.model_fields["format"]
    assert get_args(field.annotation) == ("auto", *FORMATS)
    assert all(name in (field.description or "") for name in FORMATS)


def test_the_documentation_names_every_format() -> None:
    page = (Path(__file__).parents[3] / "docs" / "guides" / "captures.md").read_text("utf-8")
    documented = [row.split("|")[2].strip(" `") for row in page.splitlines() if row.startswith("| ")]
    assert set(FORMATS) <= set(documented)


def test_the_first_format_of_the_table_that_fits_is_taken(tmp_path: Path, photos, write) -> None:
    write.json(tmp_path / "transforms.json", write.transforms(photos))
    write.photos(tmp_path / "images", photos)
    matching = [name for name, each in FORMATS.items() if each.detect(tmp_path)]
    assert matching == ["transforms", "photos"]
    assert len(load_capture(tmp_path).views) == len(photos.names)
