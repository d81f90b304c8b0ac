"""Laws of the sheet: every picture is where its row and column are, in its own colours and proportions."""

import numpy as np
import pytest

from tron.report.contact_sheet import labelled_sheet

RED, GREEN = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
LABEL, HEAD, GAP = 110, 18, 2


def place(row: int, column: int, width: int, height: int) -> tuple[slice, slice]:
    top, left = HEAD + row * (height + GAP), LABEL + column * (width + GAP)
    return slice(top, top + height), slice(left, left + width)


def test_pictures_lie_in_their_rows_and_columns():
    plain = {"a": [RED, GREEN], "b": [GREEN, RED], "c": [RED, RED]}
    rows = {name: [np.broadcast_to(c, (20, 40, 3)) for c in colors] for name, colors in plain.items()}
    sheet = labelled_sheet(rows, ["one", "two"], width=80)
    assert sheet.dtype == np.uint8
    assert sheet.shape == (HEAD + 3 * (40 + GAP), LABEL + 2 * (80 + GAP), 3)
    for row, colors in enumerate(plain.values()):
        for column, color in enumerate(colors):
            assert (sheet[place(row, column, 80, 40)] == np.uint8(255 * color)).all()


def test_grey_maps_and_values_outside_zero_to_one():
    grey = np.tile([-1.0, 0.5, 7.0], (3, 1))
    sheet = labelled_sheet({"roughness": [grey]}, ["v"], width=30)
    seen = sheet[place(0, 0, 30, 30)]
    assert (seen[:, :10] == 0).all()
    assert (seen[:, 10:20] == 128).all()
    assert (seen[:, 20:] == 255).all()


def test_small_pictures_are_enlarged_without_new_colours_and_large_ones_averaged():
    checks = (np.indices((4, 4)).sum(0) % 2).astype(float)
    enlarged = labelled_sheet({"x": [checks]}, ["v"], width=40)[place(0, 0, 40, 40)]
    assert set(np.unique(enlarged)) == {0, 255}
    fine = (np.indices((400, 400)).sum(0) % 2).astype(float)
    reduced = labelled_sheet({"x": [fine]}, ["v"], width=40)[place(0, 0, 40, 40)]
    assert np.abs(reduced.astype(int) - 128).max() < 40


def test_columns_of_other_proportions_have_room():
    wide, tall = np.broadcast_to(RED, (10, 40, 3)), np.broadcast_to(GREEN, (40, 10, 3))
    sheet = labelled_sheet({"a": [wide, tall], "b": [wide, tall]}, ["wide", "tall"], width=20)
    assert (sheet[HEAD : HEAD + 5, LABEL : LABEL + 20] == np.uint8(255 * RED)).all()
    assert (sheet[place(1, 1, 20, 80)] == np.uint8(255 * GREEN)).all()


@pytest.mark.parametrize("heading", ["", "x" * 300, "vue_été_07"])
def test_any_name_makes_a_heading_that_leaves_the_pictures_alone(heading: str):
    picture = np.broadcast_to(RED, (30, 30, 3))
    sheet = labelled_sheet({"photo": [picture, picture]}, [heading, "b"], width=60)
    for column in range(2):
        assert (sheet[place(0, column, 60, 60)] == np.uint8(255 * RED)).all()
    assert (sheet[:HEAD, LABEL:] < 128).any()
