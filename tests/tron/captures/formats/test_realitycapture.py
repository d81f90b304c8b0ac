"""RealityCapture's angles are a compass course and a tilt from straight down; bad rows are one line each."""

from pathlib import Path

import numpy as np
import pytest

from tron.captures import LoadSettings, load_capture
from tron.captures.formats.realitycapture import read_realitycapture, registration_file
from tron.errors import TronError
from tron.lenses import Lens

PLACES = "#name,x,y,alt,heading,pitch,roll"
TITLES = f"{PLACES},f,px,py,k1,k2,k3,k4,t1,t2"
ROW = "1,2,3,0,90,0,18,0,0,0,0,0,0,0,0"


def registered(folder: Path, write, *rows: str, titles: str = TITLES) -> Path:
    for name in ("a", "b", "c"):
        write.save(folder / f"{name}.png", write.picture(1))
    (folder / "cameras.csv").write_text("\n".join([titles, *rows]) + "\n")
    return folder / "cameras.csv"


@pytest.mark.parametrize(
    ("angles", "forward", "up"),
    [
        ("0,0,0", (0, 0, -1), (0, 1, 0)),
        ("90,0,0", (0, 0, -1), (1, 0, 0)),
        ("0,90,0", (0, 1, 0), (0, 0, 1)),
        ("90,90,0", (1, 0, 0), (0, 0, 1)),
        ("225,90,0", (-(0.5**0.5), -(0.5**0.5), 0), (0, 0, 1)),
        ("0,0,30", (-0.5, 0, -(0.75**0.5)), (0, 1, 0)),
    ],
)
def test_heading_is_a_course_and_pitch_lifts_the_view_from_straight_down(
    tmp_path: Path, write, angles: str, forward, up
) -> None:
    """Courses count from north, y, by east, x; roll turns about the course."""
    registered(tmp_path, write, f"a.png,0,0,0,{angles},18", f"b.png,{ROW}", titles=f"{PLACES},f")
    camera = load_capture(tmp_path).views[0].camera
    assert np.allclose(camera.forward, forward)
    assert np.allclose(camera.up, up)


def test_focal_length_is_that_of_film_and_all_is_in_longer_sides(tmp_path: Path, write) -> None:
    numbers = "18,0.01,-0.02,0.1,-0.2,0.03,0,0.001,0.002"
    rows = [f"{name}.png,1,2,3,0,90,0,{numbers}" for name in "ab"]
    file = registered(tmp_path, write, *rows)
    photo = read_realitycapture(file, LoadSettings()).photos[0]
    assert callable(photo.lens)
    wide, tall = photo.lens(1000, 800), photo.lens(800, 1000)
    distortion = (0.1, -0.2, 0.001, 0.002, 0.03, 0, 0, 0)
    assert wide == Lens("FULL_OPENCV", 1000, 800, (500, 500, 510, 380, *distortion))
    assert tall == Lens("FULL_OPENCV", 800, 1000, (500, 500, 410, 480, *distortion))


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("c.png,1,2,3,0,90,0,18,0,0,0,0", "its row ends before k3"),
        ("c.png,1,2", "its row ends before alt"),
        ("c.png,1,nan,3,0,90,0,18,0,0,0,0,0,0,0,0", "y is 'nan', not a number"),
        ("c.png,1,2,3,0,x,0,18,0,0,0,0,0,0,0,0", "pitch is 'x', not a number"),
        ("c.png,1,2,3,0,90,0,0,0,0,0,0,0,0,0,0", "focal length is 0.0"),
        ("c.png,1,2,3,0,90,0,18,0,0,0,0,0,0.1,0,0", "calibrated with k4"),
        (f"absent.png,{ROW}", "image not found"),
        (f"a.png,{ROW}", "named more than once"),
    ],
)
def test_a_bad_row_is_left_out_with_its_reason(tmp_path: Path, write, row: str, reason: str) -> None:
    file = registered(tmp_path, write, f"a.png,{ROW}", f"b.png,{ROW}", row)
    for given in (tmp_path, file):
        capture = load_capture(given)
        assert [view.name for view in capture.views] == ["a", "b"]
        assert len(capture.skipped) == 1
        assert reason in next(iter(capture.skipped.values()))


def test_a_name_that_climbs_out_is_refused(tmp_path: Path, write) -> None:
    registered(tmp_path, write, f"../a.png,{ROW}", f"b.png,{ROW}")
    with pytest.raises(TronError, match="leads out of the capture's folder"):
        load_capture(tmp_path)


def test_a_flight_log_and_a_table_without_rows_are_no_registration(tmp_path: Path, write) -> None:
    """A log of places and angles lies beside many a drone's photos, which are then posed."""
    file = registered(tmp_path, write, "a.png,1,2,3,0,90,0", titles=PLACES)
    assert registration_file(tmp_path) is None
    with pytest.raises(TronError, match=r"RealityCapture's cameras.*Internal/External camera parameters"):
        load_capture(file)
    registered(tmp_path, write)
    with pytest.raises(TronError, match="no camera of it is registered"):
        load_capture(tmp_path)
