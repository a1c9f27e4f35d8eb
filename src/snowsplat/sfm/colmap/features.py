"""Features of the photos, and which of them match: what goes into the database."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from snowsplat.sfm.colmap.database import count_rows, set_names, trim_features
from snowsplat.sfm.colmap.options import Effort
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.progress import Report

# Pairs that are compared before they are written: what a kill loses, and how often progress shows.
_BLOCK = 64

# No photo has more than so many times the features that were asked for.
_MOST = 2

SEED = 1


@dataclass(frozen=True)
class Folders:
    """Where the parts of a dataset lie."""

    dataset: Path

    @property
    def images(self) -> Path:
        return self.dataset / "input"

    @property
    def distorted(self) -> Path:
        return self.dataset / "distorted"

    @property
    def masks(self) -> Path:
        return self.distorted / "masks"

    @property
    def database(self) -> Path:
        return self.distorted / "database.db"

    @property
    def sparse(self) -> Path:
        return self.distorted / "sparse"


@dataclass(frozen=True)
class Teller:
    """How progress gets to the parent process.

    What COLMAP writes into its database is counted over there: two copies of SQLite in one process
    (COLMAP has its own) break each other's locks on a database that both have open.
    """

    report: Report
    watch: Callable[[str, str, int, str], None]  # database, table, rows in the end, what they are


def extract_features(
    folders: Folders,
    database: Path,
    photos: list[Photo],
    effort: Effort,
    threads: int,
    teller: Teller,
) -> None:
    """Find the features of photos that have none yet in ``database``."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = effort.image_size
    options.num_threads = threads
    options.use_gpu = False
    options.sift.max_num_features = effort.features
    options.sift.first_octave = effort.first_octave
    with _counted(database, "keypoints", len(photos), "features", teller):
        # COLMAP skips a photo whose mask it does not find, so those without go by themselves.
        for masked in (False, True):
            names = [photo.name for photo in photos if photo.mask == masked]
            reader = pycolmap.ImageReaderOptions()
            if masked:
                reader.mask_path = folders.masks
            if names:
                pycolmap.extract_features(
                    database,
                    folders.images,
                    image_names=names,
                    camera_mode=pycolmap.CameraMode.PER_IMAGE,
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )
    trim_features(database, _MOST * effort.features)


def match_pairs(
    database: Path,
    photos: list[Photo],
    pairs: list[tuple[int, int]],
    max_error: float,
    threads: int,
    teller: Teller,
) -> None:
    """Match the features of those of ``pairs`` (indices of photos) that are not in the database.

    ``max_error`` is how far a match may be from the motion of its pair, in pixels.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    options.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.max_error = max_error
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.block_size = _BLOCK
    pairing.match_list_path = database.with_suffix(".pairs")
    # A blank ends a name in COLMAP's list of pairs: the images go by their numbers meanwhile.
    set_names(database, [str(i) for i in range(len(photos))])
    Path(pairing.match_list_path).write_text("".join(f"{i} {j}\n" for i, j in pairs))
    try:
        with _counted(database, "two_view_geometries", len(pairs), "pairs", teller):
            pycolmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
    finally:
        os.remove(pairing.match_list_path)
        set_names(database, [photo.name for photo in photos])


@contextmanager
def _counted(database: Path, table: str, total: int, what: str, teller: Teller) -> Iterator[None]:
    # While the block runs, COLMAP has the database open; see `Teller`.
    teller.report(min(count_rows(database, table), total), total, what)
    teller.watch(str(database), table, total, what)
    yield
    teller.report(total, total, what)
