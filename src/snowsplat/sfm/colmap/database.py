"""The COLMAP database of a dataset: features and matches, reused after an interrupted run.

The photo with index i in the list of photos has the image id i + 1 and the frame id i + 1. The ids
do not depend on the timing of threads, so the same photos always lead to the same database. The
database stores a fingerprint of the photos and settings. Its features and matches are reused only
if the fingerprint is unchanged.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.lenses.lens import Lens, camera_ids, cameras_of
from snowsplat.sfm.colmap.mapping.tracks import of_long_tracks
from snowsplat.sfm.ingest.photo import Photo

_PLANE_OR_ROTATION = {"PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC", "WATERMARK"}

# Share of the matches of a pair that move if the camera does. Others may be fixed to the frame. If
# the camera stands still, people and leaves that move have fewer matches.
_MOVING_SHARE = 0.25
#: This number of inliers tells a pose: matches that agree with the pose of one photo relative to
#: another, or points that a photo sees.
MIN_INLIERS = 15
#: Unrelated photos can have about this number of verified matches by chance, so poses are not
#: compared with pairs that have fewer.
MIN_MATCHES = 50
# Photos that follow each other were usually taken side by side, so their matches are rarely false,
# and each match counts as `_FOLLOWING_WEIGHT` matches. In five datasets with correct poses, the
# model confirms all 692 pairs of this kind.
_FOLLOWING_WEIGHT = 20.0


@dataclass(frozen=True)
class VerifiedPair:
    """Two photos with verified matches: image ids of the database, ``first`` < ``second``."""

    first: int
    second: int
    matches: int  # number of verified matches
    # The matches are also consistent with a plane or with a pure rotation.
    flat: bool = field(default=False, kw_only=True)
    follows: bool = field(default=False, kw_only=True)  # see `view_graph.following_pairs`

    @property
    def weight(self) -> float:
        """The number of matches; those of photos that follow each other count several times."""
        return self.matches * (_FOLLOWING_WEIGHT if self.follows else 1.0)

    @property
    def counts(self) -> bool:
        """Whether the pair has enough matches to be compared with poses."""
        return self.matches >= (MIN_INLIERS if self.follows else MIN_MATCHES)

    def other(self, photo: int) -> int:
        """The photo of this pair that is not ``photo``."""
        return self.first + self.second - photo


def open_database(path: Path, photos: list[Photo], lens: Lens, fingerprint: str) -> None:
    """Make the database ``path`` ready for ``photos``; keep its features and matches if valid.

    They are valid if the database is not damaged and has the same ``fingerprint``. Otherwise, a new
    database is created. Cameras are always rewritten, because the features do not depend on the
    lens.
    """
    if not _is_valid(path, fingerprint):
        remove_database(path)
        with closing_database(path) as database:
            _write_cameras(database, photos, lens)
            for image_id, (photo, camera_id) in enumerate(
                zip(photos, camera_ids(photos), strict=True), start=1
            ):
                image = pycolmap.Image(name=photo.name, camera_id=camera_id, image_id=image_id)
                database.write_image(image, use_image_id=True)
                frame = pycolmap.Frame()
                frame.frame_id, frame.rig_id = image_id, camera_id
                frame.add_data_id(image.data_id)
                frame.finalize_data_ids()
                database.write_frame(frame, use_frame_id=True)
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute("CREATE TABLE snowsplat (fingerprint TEXT)")
            connection.execute("INSERT INTO snowsplat VALUES (?)", (fingerprint,))
    else:
        with closing(sqlite3.connect(path)) as connection, connection:
            # Of a run that was interrupted between the two writes of the features of a photo.
            connection.execute(
                "DELETE FROM keypoints WHERE image_id NOT IN (SELECT image_id FROM descriptors)"
            )
        set_cameras(path, photos, lens)


def set_cameras(path: Path, photos: list[Photo], lens: Lens) -> None:
    """Replace the cameras by those with which an attempt begins; the groups may be other ones."""
    with closing_database(path) as database:
        _write_cameras(database, photos, lens)
    ids = camera_ids(photos)
    rows = [(camera_id, image_id) for image_id, camera_id in enumerate(ids, start=1)]
    with closing(sqlite3.connect(path)) as connection, connection:
        for table, column, key in (
            ("images", "camera_id", "image_id"),
            ("frames", "rig_id", "frame_id"),
            ("frame_data", "sensor_id", "frame_id"),
        ):
            connection.executemany(f"UPDATE {table} SET {column} = ? WHERE {key} = ?", rows)
        for table, column in (("rigs", "rig_id"), ("cameras", "camera_id")):
            connection.execute(f"DELETE FROM {table} WHERE {column} > ?", (max(ids),))


def copy_without_verification(path: Path, target: Path) -> None:
    """Copy the database to ``target``, without the results of the verification of matches."""
    remove_database(target)
    with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(target)) as connection:
        source.backup(connection)
        with connection:
            connection.execute("DELETE FROM two_view_geometries")


def remove_database(path: Path) -> None:
    """Remove the database, if it exists, and the files that SQLite writes beside it."""
    for suffix in ("", "-journal", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def replace_database(path: Path, by: Path) -> None:
    """Replace the database ``path`` by the database ``by``."""
    with closing(sqlite3.connect(by)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    remove_database(path)
    by.rename(path)
    remove_database(by)


def copy_for_mapping(path: Path, target: Path, without: Iterable[tuple[int, int]]) -> None:
    """Copy the part of the database that the mapper reads to ``target``.

    The mapper does not need the descriptors and the matches before verification. The verified
    matches of the pairs ``without`` (two image ids each) are not copied either.
    """
    remove_database(target)
    ids = [(pycolmap.image_pair_to_pair_id(*pair),) for pair in sorted(without)]
    with closing(sqlite3.connect(target)) as connection:
        connection.execute("ATTACH DATABASE ? AS source", (str(path),))
        (version,) = connection.execute("PRAGMA source.user_version").fetchone()
        connection.execute(f"PRAGMA main.user_version = {int(version)}")
        objects = connection.execute(
            "SELECT type, name, sql FROM source.sqlite_master WHERE sql IS NOT NULL "
            "AND name NOT LIKE 'sqlite_%' ORDER BY type DESC"
        ).fetchall()
        with connection:
            for kind, name, sql in objects:
                connection.execute(sql)
                if kind == "table" and name not in ("descriptors", "matches"):
                    connection.execute(f'INSERT INTO main."{name}" SELECT * FROM source."{name}"')
            connection.executemany("DELETE FROM main.two_view_geometries WHERE pair_id = ?", ids)


def keep_matches_of_long_tracks(path: Path) -> None:
    """Remove the verified matches that `tracks.of_long_tracks` does not choose."""
    with closing(sqlite3.connect(path)) as connection, connection:
        found = connection.execute(
            "SELECT pair_id, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
        ).fetchall()
        counts = dict(connection.execute("SELECT image_id, rows FROM keypoints"))
        rows = [np.frombuffer(data, np.uint32).reshape(-1, 2) for _, data in found]
        ids = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id, _ in found]
        kept = of_long_tracks([(*i, r) for i, r in zip(ids, rows, strict=True)], counts)
        connection.executemany(
            "UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?",
            [
                (int(keep.sum()), matched[keep].tobytes(), pair_id)
                for (pair_id, _), matched, keep in zip(found, rows, kept, strict=True)
            ],
        )


@contextmanager
def closing_database(path: Path) -> Iterator[pycolmap.Database]:
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def fingerprint_of(images: Path, photos: list[Photo], settings: object) -> str:
    """A hash of all that features and matches depend on: files, settings, versions of libraries.

    They do not depend on the groups of photos, of which the first is only a guess.
    """
    files = [(images / photo.name).stat() for photo in photos]
    facts = [
        pycolmap.__version__,
        cv2.__version__,
        repr(settings),
        [
            [p.name, p.width, p.height, p.focal, p.mask, s.st_size, s.st_mtime_ns]
            for p, s in zip(photos, files, strict=True)
        ],
    ]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def _is_valid(path: Path, fingerprint: str) -> bool:
    if not path.is_file():
        return False
    try:
        with closing(sqlite3.connect(path)) as connection:
            found = connection.execute("SELECT fingerprint FROM snowsplat").fetchall()
            # COLMAP does not sync the file to disk, so it may be damaged after a power failure.
            return found == [(fingerprint,)] and connection.execute(
                "PRAGMA quick_check"
            ).fetchall() == [("ok",)]
    except sqlite3.DatabaseError:
        return False


def _write_cameras(database: pycolmap.Database, photos: list[Photo], lens: Lens) -> None:
    """Write the cameras, each with a rig of the same id, or replace those with the same ids."""
    for camera in cameras_of(photos, lens):
        if database.exists_camera(camera.camera_id):
            database.update_camera(camera)
        else:
            database.write_camera(camera, use_camera_id=True)
        if not database.exists_rig(camera.camera_id):  # an interrupted run may lack it
            rig = pycolmap.Rig()
            rig.rig_id = camera.camera_id
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)


def feature_counts(path: Path, photo_count: int) -> list[int]:
    """Number of features of each photo; 0 if none were found or the photo could not be read."""
    counts = [0] * photo_count
    with closing(sqlite3.connect(path)) as connection:
        for image_id, rows in connection.execute("SELECT image_id, rows FROM keypoints"):
            counts[image_id - 1] = rows
    return counts


def match_counts(path: Path) -> dict[tuple[int, int], int]:
    """Number of matches before verification, by the two indices of photos."""
    with closing(sqlite3.connect(path)) as connection:
        rows = connection.execute("SELECT pair_id, rows FROM matches").fetchall()
    ids = {pair_id: pycolmap.pair_id_to_image_pair(pair_id) for pair_id, _ in rows}
    return {(ids[key][0] - 1, ids[key][1] - 1): count for key, count in rows}


def verified_pairs(path: Path) -> list[VerifiedPair]:
    """All pairs that have at least one verified match (consistent with a relative pose)."""
    kinds = pycolmap.TwoViewGeometryConfiguration.__members__.items()
    flat = {int(config) for name, config in kinds if name in _PLANE_OR_ROTATION}
    query = "SELECT pair_id, rows, config FROM two_view_geometries WHERE rows > 0"
    with closing(sqlite3.connect(path)) as connection:
        return [
            VerifiedPair(*pycolmap.pair_id_to_image_pair(pair_id), matches, flat=config in flat)
            for pair_id, matches, config in connection.execute(query)
        ]


def read_descriptors(path: Path, index: int, limit: int) -> NDArray[np.float32]:
    """(K, 128) float32: those of the K ≤ ``limit`` largest features of the photo ``index``."""
    with closing_database(path) as database:
        if not database.exists_descriptors(index + 1):
            return np.zeros((0, 128), np.float32)
        keypoints = database.read_keypoints(index + 1)
        descriptors = np.asarray(database.read_descriptors(index + 1).data, np.float32)
    if len(descriptors) == 0:
        return np.zeros((0, 128), np.float32)
    # The columns after x and y are the matrix of the affine shape, whose determinant is the squared
    # scale of the feature.
    scale = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    return descriptors[np.argsort(-scale, kind="stable")[:limit]]


def displacements_of(path: Path, pairs: Sequence[VerifiedPair], still: float) -> list[float]:
    """For each pair, the median distance in pixels between the positions of a match in the photos.

    If a quarter of the matches moves by more than ``still`` pixels, the median is that of these
    matches: the others may be those of a logo, which does not move with the scene.
    """
    medians = []
    with closing_database(path) as database:
        for pair in pairs:
            ids = pair.first, pair.second
            matches = database.read_two_view_geometry(*ids).inlier_matches
            first, second = (database.read_keypoints(i)[:, :2] for i in ids)
            shift = first[matches[:, 0]] - second[matches[:, 1]]
            lengths = np.linalg.norm(shift, axis=1)
            moving = lengths > still
            lengths = lengths[moving] if moving.mean() >= _MOVING_SHARE else lengths
            medians.append(float(np.median(lengths)))
    return medians
