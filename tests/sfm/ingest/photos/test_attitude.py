"""Up and north in the frame of a photo, as drones and phones write them."""

import json
import struct

import numpy as np
import pytest
from pillow_heif import register_heif_opener

from snowsplat.sfm.ingest.photos.exif import read_exif
from snowsplat.sfm.ingest.photos.photo_files import read_header

from ...pictures import exif, photo


def gimbal(pitch, roll=0.0, yaw=0.0, form='drone-dji:Gimbal{}Degree="{:+.2f}"'):
    angles = {"Pitch": pitch, "Roll": roll, "Yaw": yaw}
    return " ".join(form.format(*each) for each in angles.items()).encode()


def apple_note(vector, order=">"):
    """A maker note with two tags; the values of the vector stand behind them."""
    head = b"Apple iOS\0\0\x01" + (b"MM" if order == ">" else b"II")
    entries = struct.pack(f"{order}HHHII", 2, 1, 9, 1, 5)
    entries += struct.pack(f"{order}HHII", 8, 10, 3, 14 + 2 + 24 + 4)
    numbers = [n for value in vector for n in (round(value * 10000), 10000)]
    return head + entries + struct.pack(f"{order}I6i", 0, *numbers)


def attitude(xmp=b"", orientation=1, **groups):
    tags = groups.pop("tags", {}) | {0x0112: orientation}
    return read_exif(exif(tags, **groups), 4000, 3000, xmp).attitude


@pytest.mark.parametrize(
    ("pitch", "yaw", "up", "north"),
    [
        (0, 0, (0, -1, 0), (0, 0, 1)),
        (0, 90, (0, -1, 0), (-1, 0, 0)),  # looks east: north is to the left
        (-90, 0, (0, 0, -1), (0, -1, 0)),  # straight down: north is at the upper edge
        (-90, 90, (0, 0, -1), (-1, 0, 0)),
        (-30, 180, (0, -0.866025, -0.5), (0, 0.5, -0.866025)),
    ],
)
@pytest.mark.parametrize("element", [False, True])
def test_gimbal_angles(pitch, yaw, up, north, element):
    forms = {"form": "<drone-parrot:Camera{}Degree>{}</>"} if element else {}
    found = attitude(gimbal(pitch, 0, yaw, **forms))
    assert found.gimbal
    np.testing.assert_allclose(found.up, up, atol=1e-6)
    np.testing.assert_allclose(found.north, north, atol=1e-6)


def test_a_roll_turns_the_camera_clockwise():
    """Its right side is lower, so up leans to the left of the photo."""
    found = attitude(gimbal(0, 10, 0))
    assert found.up[0] == pytest.approx(-np.sin(np.radians(10)), abs=1e-6)


@pytest.mark.parametrize(
    "xmp", [gimbal(-90)[:30], b'drone-dji:GimbalPitchDegree="x"', b"\xff" * 99]
)
def test_damaged_gimbal_angles(xmp):
    assert attitude(xmp) is None


@pytest.mark.parametrize("order", [">", "<"])
@pytest.mark.parametrize(
    ("vector", "orientation", "up"),
    [
        ((0, -1, 0), 6, (0, -1, 0)),  # held upright
        ((-1, 0, 0), 1, (0, -1, 0)),  # on its left side
        ((1, 0, 0), 3, (0, -1, 0)),
        ((0, 1, 0), 8, (0, -1, 0)),  # upside down
        ((0, -0.6, -0.8), 6, (0, -0.6, -0.8)),  # looks down: the screen faces up
        ((0, -0.8, 0.6), 6, (0, -0.8, 0.6)),  # looks up
        ((0.1, -0.99, 0), 6, (-0.1, -0.99, 0)),  # its right side is lower
    ],
)
def test_the_accelerometer_of_a_phone(vector, orientation, up, order):
    found = attitude(orientation=orientation, details={0x927C: apple_note(vector, order)})
    assert not found.gimbal
    assert found.north is None
    np.testing.assert_allclose(found.up, np.array(up) / np.linalg.norm(up), atol=2e-3)


def test_a_level_photo_that_another_program_has_turned():
    """Its orientation is 1 now, and the maker note is the old one."""
    found = attitude(orientation=1, details={0x927C: apple_note((0.1, -0.99, 0))})
    np.testing.assert_allclose(found.up, (-0.1, -0.995, 0), atol=2e-3)


@pytest.mark.parametrize(
    "note",
    [
        apple_note((0, -1.5, 0)),  # the phone is moved
        apple_note((0, -1, 0))[:-8],
        apple_note((0, -1, 0))[:20],
        b"Apple iOS\0",
        b"Nikon\0\2\0",
    ],
)
def test_unusable_maker_notes(note):
    assert attitude(details={0x927C: note}) is None


def test_the_front_camera_has_other_axes():
    details = {0x927C: apple_note((0, -1, 0)), 0xA434: "iPhone 12 front camera 2.71mm f/2.2"}
    assert attitude(orientation=6, details=details) is None


@pytest.mark.parametrize("vector", [(0.99, 0.1, 0.06), (-0.99, -0.1, 0.06), (-0.1, 0.99, 0.06)])
def test_the_description_of_a_street_photo(vector):
    text = json.dumps({"MAPAccelerometerVector": dict(zip("xyz", vector, strict=True))})
    found = attitude(tags={0x010E: text})
    assert found.up[1] < -0.98
    assert abs(found.up[0]) == pytest.approx(0.1, abs=0.01)
    assert found.up[2] == pytest.approx(0.06, abs=0.01)


@pytest.mark.parametrize(
    "text",
    ['{"MAPAccelerometerVector": 3}', "MAPAccelerometerVector", '{"MAPAccelerometerVector": {}}'],
)
def test_damaged_descriptions(text):
    assert attitude(tags={0x010E: text}) is None


def test_the_compass_counts_only_with_true_north():
    found = attitude(gps={16: "T", 17: 90.0})
    assert found.up is None
    np.testing.assert_allclose(found.north, (-1, 0, 0), atol=1e-6)
    assert attitude(gps={16: "M", 17: 90.0}) is None
    assert attitude(gps={16: "T", 17: 900.0}) is None


def test_mirrored_photos_have_no_attitude():
    assert attitude(gimbal(-90), orientation=2) is None


def test_the_packet_of_a_file_is_read(tmp_path):
    photo().save(tmp_path / "a.jpg", exif=exif(), xmp=gimbal(-90))
    assert read_header(tmp_path / "a.jpg").exif.attitude.up == pytest.approx((0, 0, -1))


def test_a_heic_file_tells_how_it_was_taken(tmp_path):
    """Pixels of HEIC files are upright, and their orientation reads 1."""
    data = exif({0x0112: 6}, {0x927C: apple_note((0, -0.6, -0.8))})
    register_heif_opener()
    photo().save(tmp_path / "a.heic", exif=data.tobytes())
    found = read_header(tmp_path / "a.heic").exif.attitude
    np.testing.assert_allclose(found.up, (0, -0.6, -0.8), atol=2e-3)
