"""Agisoft Metashape's cameras, an XML of File > Export > Export Cameras, beside the photos.

A camera has a label, the photo's name with or without its suffix, the id of its sensor, and its transform: 16
numbers, row after row, camera to the chunk's own world, OpenCV's camera axes. A sensor has its resolution and
a calibration: f, cx and cy from the middle of the picture, in pixels, b1 (how much wider pixels are seen), b2
(skew), k1 to k4, p1 and p2. Metashape's p1 is OpenCV's p2 and the other way round (Metashape manual, appendix
"Camera models"). A spherical sensor, of equirectangular photos of 360 degrees, has its resolution alone.
Cameras of several components stand in worlds of their own: the largest is read.

Of a rig of several sensors one is the master. The others' cameras have no transform but the id of the
master's camera of the same moment, and their sensors have the rotation and the location that lead from the
slave's axes to the master's: the pose of a slave is its master's times these.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree  # expat limits what entities expand to, and follows none outside the file

import numpy as np

from tron.cameras import rigid_pose
from tron.captures.photos.image_folder import ImageFolder
from tron.captures.photos.panoramas import Panorama
from tron.captures.photos.photographs import PosedPhoto, PosedPhotos
from tron.captures.settings import PhotoSettings
from tron.errors import TronError, located
from tron.lenses import Lens, opencv_lens

log = logging.getLogger(__name__)

_START = 4096


def cameras_file(path: Path) -> Path | None:
    """The XML of cameras that a path is, or the first that a folder holds; None where there is none."""
    if path.is_dir():
        return next(filter(None, map(cameras_file, sorted(path.glob("*.xml")))), None)
    if path.suffix.lower() != ".xml":
        return None
    try:
        with path.open("rb") as stream:
            head = stream.read(_START)
    except OSError:
        return None
    return path if b"<document" in head and b"<chunk" in head else None


def read_metashape(path: Path, settings: PhotoSettings) -> PosedPhotos:
    """Read a chunk's cameras; the world is the chunk's.

    Args:
        path: the XML, or a folder that holds it; photos are sought there and one folder down.
        settings: ``images``, where they are instead.

    Raises:
        TronError: no XML of cameras, or one that is damaged.
    """
    file = cameras_file(path)
    if file is None:
        raise TronError("no XML of Metashape's cameras", path)
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, OSError) as error:
        raise TronError(f"not a readable XML: {error}", file) from error
    chunks = [each for each in root.iter("chunk") if each.find(".//cameras//camera/transform") is not None]
    if not chunks:
        raise TronError("no camera of it is aligned", file, "align the photos and export the cameras again")
    chunk = max(chunks, key=lambda each: len(each.findall(".//cameras//camera/transform")))
    if len(chunks) > 1:
        log.info("%s: of %d chunks the largest is read, %s", file, len(chunks), chunk.get("label"))
    with located(file):
        lenses = {each.get("id"): each for each in chunk.iterfind("sensors/sensor")}
        cameras = [each for each in chunk.iterfind(".//cameras//camera") if each.get("label")]
        poses = {each.get("id", ""): text for each in cameras if (text := each.findtext("transform"))}
        of_component = Counter(
            each.get("component_id") for each in cameras if each.find("transform") is not None
        )
        largest = of_component.most_common(1)[0][0]
        images = ImageFolder(file.parent, settings.images)
        folders = ["", *(f"{each.name}/" for each in sorted(file.parent.iterdir()) if each.is_dir())]
        photos = []
        for camera in cameras:
            apart = camera.get("component_id") != largest and camera.find("transform") is not None
            sensor = lenses.get(camera.get("sensor_id"))
            photos.append(
                _photo(camera, sensor, poses, images, folders, file)
                if not apart
                else PosedPhoto(camera.get("label", ""), None, None, None, refused="of another component")
            )
    return PosedPhotos(path, photos)


def _photo(
    camera: ElementTree.Element,
    sensor: ElementTree.Element | None,
    poses: Mapping[str, str],
    images: ImageFolder,
    folders: list[str],
    file: Path,
) -> PosedPhoto:
    label, matrix = camera.get("label", ""), camera.findtext("transform")
    master = camera.get("master_id") if matrix is None else None
    if master is not None:
        matrix = poses.get(master)
    found = (images.find(folder + label, file) for folder in folders)
    image = next((each for each in found if each is not None), None)
    try:
        if matrix is None:
            raise TronError("not aligned" if master is None else "the master of its rig is not aligned")
        if sensor is None:
            raise TronError("its sensor is missing")
        lens = _lens(sensor)
        pose = rigid_pose(np.reshape(_numbers(matrix), (4, 4)))
        if master is not None:
            pose = pose @ _in_rig(sensor)
    except TronError as error:
        return PosedPhoto(label, image, None, None, refused=error.what)
    except ValueError:
        what = "rotation and location in its rig are not numbers" if master else "transform is not 16 numbers"
        return PosedPhoto(label, image, None, None, refused=what)
    return PosedPhoto(label, image, pose, lens)


def _in_rig(sensor: ElementTree.Element) -> np.ndarray:
    """(4, 4) from a slave's axes to its master's; TronError or ValueError where the sensor does not say."""
    rotation, location = sensor.findtext("rotation"), sensor.findtext("location")
    if rotation is None or location is None:
        raise TronError("a slave of a rig whose sensor has no rotation and location: calibrate the rig")
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(_numbers(rotation), (3, 3))
    matrix[:3, 3] = np.reshape(_numbers(location), 3)
    return rigid_pose(matrix)


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _lens(sensor: ElementTree.Element) -> Lens | Panorama:
    calibrations = sensor.findall("calibration")
    # Where photos were aligned there are two: what was given, and what was found.
    calibration = next((each for each in calibrations if each.get("class") == "adjusted"), None)
    calibration = calibration if calibration is not None else next(iter(calibrations), None)
    resolution = sensor.find("resolution")
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "spherical"):
        raise TronError(f"cameras of type {kind} are not supported")
    if resolution is None or (calibration is None and kind == "frame"):
        raise TronError("its sensor is not calibrated")
    width, height = (float(resolution.get(name, 0)) for name in ("width", "height"))
    if kind == "spherical" or calibration is None:
        return Panorama(width, height)

    def value(name: str) -> float:
        return float(calibration.findtext(name) or 0.0)

    if value("k4"):
        raise TronError("calibrated with k4, which is not supported: calibrate without it")
    if value("b2"):
        raise TronError("calibrated with b2, skew, which is not supported: calibrate without it")
    return opencv_lens(
        width,
        height,
        (value("f") + value("b1"), value("f")),
        (0.5 * width + value("cx"), 0.5 * height + value("cy")),
        radial=(value("k1"), value("k2"), value("k3")),
        tangential=(value("p2"), value("p1")),
    )
