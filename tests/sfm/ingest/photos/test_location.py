"""Locations in EXIF and in the XMP of drones."""

import math

import pytest

from snowsplat.sfm.ingest.photos.exif import read_exif

from ...pictures import exif

GPS = {1: "S", 2: (33.0, 51.0, 24.5), 3: "E", 4: (151.0, 12.0, 0.0), 5: b"\x00", 6: 12.5}
# What EXIF of some drones has: whole arc seconds.
ROUNDED = {1: "N", 2: (47.0, 22.0, 8.0), 3: "E", 4: (8.0, 32.0, 30.0), 5: b"\x00", 6: 431.0}
EXACT = {"GpsLatitude": "+47.36888654", "GpsLongitude": "+8.54172345"}


def xmp(**values):
    return " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items()).encode()


def read(gps, packet=b""):
    found = read_exif(exif(gps=gps), 4000, 3000, packet)
    return found.location, found.location_error


def test_location():
    latitude, longitude, altitude = read(GPS)[0]
    assert latitude == pytest.approx(-(33 + 51 / 60 + 24.5 / 3600))
    assert (longitude, altitude) == (pytest.approx(151.2), 12.5)
    assert read(GPS | {5: b"\x01"})[0][2] == -12.5


@pytest.mark.parametrize(
    "change",
    [
        {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)},
        {2: (133.0, 0.0, 0.0)},
        {2: 33.5},
        {4: (math.nan, 0.0, 0.0)},
    ],
)
def test_invalid_locations(change):
    assert read(GPS | change) == (None, None)


@pytest.mark.parametrize(
    "packet",
    [
        xmp(**EXACT),
        xmp(GpsLatitude="47.36888654", GpsLongtitude="8.54172345"),
        b"<drone-dji:GpsLatitude>47.36888654</drone-dji:GpsLatitude>"
        b"<drone-dji:GpsLongitude>8.54172345</drone-dji:GpsLongitude>",
    ],
)
def test_the_decimals_in_xmp_replace_rounded_arc_seconds(packet):
    location, error = read(ROUNDED, packet)
    assert location == (47.36888654, 8.54172345, 431.0)
    assert error is None


def test_altitude_and_deviations_of_rtk():
    packet = xmp(**EXACT, AbsoluteAltitude="+433.27", RtkStdLat="0.012", RtkStdLon="0.015")
    location, error = read(ROUNDED | {31: 3.0}, packet)
    assert location[2] == 433.27
    assert error == 0.015


def test_the_deviation_that_is_stated_for_pix4d():
    packet = xmp(**EXACT) + b' Camera:GPSXYAccuracy="0.8"'
    assert read(ROUNDED, packet)[1] == 0.8


def test_without_deviations_in_xmp_that_of_exif_holds():
    assert read(ROUNDED | {31: 3.0}, xmp(**EXACT))[1] == pytest.approx(3.0)


def test_a_location_in_xmp_alone():
    assert read({}, xmp(**EXACT))[0] == (47.36888654, 8.54172345, 0.0)


@pytest.mark.parametrize(
    "packet",
    [
        xmp(GpsLatitude="+47.40000000", GpsLongitude="+8.54172345"),  # 3 km away: of another photo
        xmp(GpsLatitude="0.00000000", GpsLongitude="0.00000000"),  # no position
        xmp(GpsLatitude="+97.36888654", GpsLongitude="+8.54172345"),
        xmp(GpsLatitude="+47.36888654"),
        xmp(GpsLatitude="unknown", GpsLongitude="+8.54172345"),
    ],
)
def test_a_useless_location_in_xmp_leaves_that_of_exif(packet):
    location, _ = read(ROUNDED, packet)
    assert location == pytest.approx((47 + 22 / 60 + 8 / 3600, 8 + 32 / 60 + 30 / 3600, 431.0))
