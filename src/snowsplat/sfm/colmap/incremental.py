"""Registers photos one after the other, in the order of their strongest pairs.

By default, COLMAP next registers a photo that sees many points of the model. If two places look
alike, this may be a photo of the other place. Its pose is then wrong, and so are the poses of the
photos that are registered from it. Here, the next photo is one that follows a registered photo by
name, if there is any; otherwise the photo whose strongest pair with a registered photo has the most
matches. So the model grows as in Prim's algorithm for the maximum spanning tree of the view graph.
If the pose of a photo contradicts its matches with the registered photos, the pose is removed. The
matches that agree with this pose are assumed to be false, and registration continues without them.

The estimation of poses and points and the bundle adjustment are those of COLMAP's incremental
mapper (Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.consistency import agreement
from snowsplat.sfm.colmap.database import closing_database, copy_for_mapping, remove_database
from snowsplat.sfm.colmap.view_graph import VerifiedPair, ViewGraph

# In degrees. The first two photos are the pair with the largest weight among the pairs whose points
# have a median triangulation angle of at least the first of these angles. If there is no such pair,
# the second angle is used. Photos that follow each other often have smaller angles than COLMAP
# requires (16).
_INITIAL_ANGLES = (8.0, 4.0)
_INITIAL_PAIRS = 100  # number of pairs that are tried for each angle
_MIN_INITIAL_POINTS = 50
# The pose of a photo agrees with a pair if at least the share `_AGREEING` of the matches agrees. It
# contradicts the pair if less than the share `_CONTRADICTING` agrees.
_AGREEING = 0.5
_CONTRADICTING = 0.3
_TRIALS = 2  # a photo that was rejected this number of times is not tried again

ImagePair = tuple[int, int]


@dataclass
class IncrementalMapper:
    """Makes models from the features and verified matches in a database.

    ``max_error`` in pixels is the largest distance of a verified match from its epipolar line.
    ``registered`` is called with the number of registered photos of the model.
    """

    database: Path
    graph: ViewGraph
    options: pycolmap.IncrementalPipelineOptions
    max_error: float
    registered: Callable[[int], None]
    _tried: set[ImagePair] = field(default_factory=set)  # initial pairs

    def start(self, photos: Collection[int]) -> pycolmap.Reconstruction | None:
        """A new model of two of ``photos`` (image ids); None if there are no two suitable photos.

        Each call starts with a pair of photos with which no earlier call started.
        """
        options = self.options.get_mapper()
        with self._mapper(photos) as mapper:
            model = pycolmap.Reconstruction()
            mapper.begin_reconstruction(model)
            for pair, pose in self._initial_pairs(mapper, options, photos):
                self._tried.add((min(pair), max(pair)))
                mapper.register_initial_image_pair(options, *pair, pose)
                for photo in pair:
                    mapper.triangulate_image(self.options.get_triangulation(), photo)
                mapper.adjust_global_bundle(options, self.options.get_global_bundle_adjustment())
                mapper.filter_points(options)
                enough = model.num_points3D() >= _MIN_INITIAL_POINTS
                if enough and mapper.find_next_images(options, False):
                    mapper.end_reconstruction(False)
                    return model
                mapper.end_reconstruction(True)
                model = pycolmap.Reconstruction()
                mapper.begin_reconstruction(model)
            mapper.end_reconstruction(True)
        return None

    def grow(self, model: pycolmap.Reconstruction, photos: Collection[int], adjust: bool) -> None:
        """Register as many of ``photos`` (image ids) in ``model`` as possible.

        ``adjust``: also run bundle adjustment. Without it, the poses that the model already has do
        not change, and a photo takes about a third of the time.
        """
        matches = _Matches(self.database, self.max_error)
        graph = self.graph.of_photos({*photos, *model.reg_image_ids()})
        false: set[ImagePair] = set()
        while True:
            with self._mapper(graph.names, false) as mapper:
                mapper.begin_reconstruction(model)
                growth = _Growth(
                    mapper, model, graph, matches, self.options, adjust, self.registered
                )
                found = growth.register_all() - false
                mapper.end_reconstruction(False)
            if not found:
                return
            false |= found

    def _initial_pairs(
        self,
        mapper: pycolmap.IncrementalMapper,
        options: pycolmap.IncrementalMapperOptions,
        photos: Collection[int],
    ) -> Iterator[tuple[ImagePair, pycolmap.Rigid3d]]:
        """Candidates for the first two photos of a model, with their relative poses."""
        pairs = sorted(self.graph.of_photos(photos).pairs, key=lambda pair: -pair.weight)
        for angle in _INITIAL_ANGLES:
            options.init_min_tri_angle = angle
            for pair in pairs[:_INITIAL_PAIRS]:
                ids = pair.first, pair.second
                if ids not in self._tried:
                    pose = mapper.estimate_initial_two_view_geometry(options, *ids)
                    if pose is not None:
                        yield ids, pose
        options.init_min_tri_angle = self.options.mapper.init_min_tri_angle
        while (found := mapper.find_initial_image_pair(options, -1, -1)) is not None:
            ids, pose = found
            if (min(ids), max(ids)) not in self._tried:
                yield ids, pose

    @contextmanager
    def _mapper(
        self, photos: Collection[int], without: Collection[ImagePair] = ()
    ) -> Iterator[pycolmap.IncrementalMapper]:
        """COLMAP's mapper for ``photos``, without the matches of the pairs ``without``."""
        options = pycolmap.DatabaseCacheOptions()
        options.min_num_matches = self.options.min_num_matches
        options.image_names = {self.graph.names[photo] for photo in photos}
        options.load_all_images = True  # also photos of the model that have no pair left
        database = self.database.with_suffix(".reduced.db") if without else self.database
        try:
            if without:
                copy_for_mapping(self.database, database, without)
            with closing_database(database) as source:
                cache = pycolmap.DatabaseCache.create(source, options)
        finally:
            if without:
                remove_database(database)
        yield pycolmap.IncrementalMapper(cache)


class _Matches:
    """The positions of the verified matches of all pairs."""

    def __init__(self, database: Path, max_error: float) -> None:
        self._database = database
        self._max_error = max_error
        self._pixels: dict[int, NDArray[np.floating[Any]]] = {}
        self._rows: dict[ImagePair, NDArray[np.integer[Any]]] = {}

    def read(self, pairs: Sequence[VerifiedPair]) -> None:
        """Read the matches of ``pairs``, if this was not done before."""
        with closing_database(self._database) as source:
            for pair in pairs:
                ids = pair.first, pair.second
                if ids not in self._rows:
                    self._rows[ids] = source.read_two_view_geometry(*ids).inlier_matches
                for photo in ids:
                    if photo not in self._pixels:
                        keypoints = source.read_keypoints(photo)[:, :2]
                        self._pixels[photo] = keypoints.astype(np.float64)

    def agreement(self, model: pycolmap.Reconstruction, pair: VerifiedPair) -> float:
        """The share of the matches that agree with the poses of the two photos."""
        ids = pair.first, pair.second
        images = [model.image(photo) for photo in ids]
        cameras = [model.camera(image.camera_id) for image in images]
        rays = [
            np.asarray(camera.cam_from_img(self._pixels[photo][rows]))
            for photo, camera, rows in zip(ids, cameras, self._rows[ids].T, strict=True)
        ]
        pose = images[1].cam_from_world() * images[0].cam_from_world().inverse()
        focal = float(np.mean([camera.mean_focal_length() for camera in cameras]))
        return agreement(pose, rays[0], rays[1], self._max_error / focal)


@dataclass
class _Growth:
    """Registers photos in ``model`` until no further photo can be registered."""

    mapper: pycolmap.IncrementalMapper
    model: pycolmap.Reconstruction
    graph: ViewGraph
    matches: _Matches
    options: pycolmap.IncrementalPipelineOptions
    adjust: bool  # run bundle adjustment
    registered: Callable[[int], None]

    def __post_init__(self) -> None:
        self._mapper_options = self.options.get_mapper()
        self._triangulation = self.options.get_triangulation()
        self._rejected: dict[int, int] = {}  # image id -> how often the photo was rejected
        self._false: set[ImagePair] = set()
        self._size = self._sizes()  # after the last global bundle adjustment
        self.matches.read(self.graph.pairs)

    def register_all(self) -> set[ImagePair]:
        """Register the photos; returns the pairs whose matches are false.

        After such a pair was found, only photos that follow a registered photo are registered.
        """
        while True:
            if self._register_next():
                self.registered(self.model.num_reg_images())
                if self.adjust and self._has_grown():
                    self._adjust_all()
            elif self.adjust and self._sizes() != self._size:
                self._adjust_all()
            else:
                break
        if not self.adjust:
            self.mapper.complete_and_merge_tracks(self._triangulation)
            self.mapper.filter_points(self._mapper_options)
        return self._false

    def _register_next(self) -> bool:
        """Register one photo, from points of the model or else from matches alone."""
        return any(self._register_one(structure_less) for structure_less in (False, True))

    def _register_one(self, structure_less: bool) -> bool:
        placed = set(self.model.reg_image_ids())
        rank = {}
        for photo in self.mapper.find_next_images(self._mapper_options, structure_less):
            pairs = [p for p in self.graph.pairs_of[photo] if p.other(photo) in placed]
            rank[photo] = max(
                ((p.counts and p.follows, p.weight) for p in pairs), default=(False, 0)
            )
        register = (
            self.mapper.register_next_structure_less_image
            if structure_less
            else self.mapper.register_next_image
        )
        for photo in sorted(rank, key=lambda photo: (rank[photo], -photo), reverse=True):
            follows, _ = rank[photo]
            if self._false and not follows:
                return False
            if self._rejected.get(photo, 0) >= _TRIALS:
                continue
            if register(self._mapper_options, photo) and self._accepts(photo, placed):
                self.mapper.triangulate_image(self._triangulation, photo)
                if self.adjust:
                    self._adjust_around(photo)
                return True
        return False

    def _accepts(self, photo: int, placed: set[int]) -> bool:
        """Whether the new pose of ``photo`` agrees with its matches; if not, remove the pose."""
        shares = {
            pair: self.matches.agreement(self.model, pair)
            for pair in self.graph.pairs_of[photo]
            if pair.other(photo) in placed
        }
        if not _contradicts(shares):
            return True
        self._rejected[photo] = self._rejected.get(photo, 0) + 1
        self._false |= {
            (pair.first, pair.second)
            for pair, share in shares.items()
            if share >= _CONTRADICTING and not pair.follows
        }
        self.mapper.observation_manager.deregister_frame(self.model.image(photo).frame_id)
        return False

    def _adjust_around(self, photo: int) -> None:
        self.mapper.iterative_local_refinement(
            self.options.ba_local_max_refinements,
            self.options.ba_local_max_refinement_change,
            self._mapper_options,
            self.options.get_local_bundle_adjustment(),
            self._triangulation,
            photo,
        )

    def _adjust_all(self) -> None:
        self.mapper.iterative_global_refinement(
            self.options.ba_global_max_refinements,
            self.options.ba_global_max_refinement_change,
            self._mapper_options,
            self.options.get_global_bundle_adjustment(),
            self._triangulation,
        )
        self.mapper.filter_frames(self._mapper_options)
        self._size = self._sizes()

    def _sizes(self) -> tuple[int, int]:
        return self.model.num_reg_images(), self.model.num_points3D()

    def _has_grown(self) -> bool:
        ratios = self.options.ba_global_frames_ratio, self.options.ba_global_points_ratio
        return any(
            size >= ratio * before
            for size, before, ratio in zip(self._sizes(), self._size, ratios, strict=True)
        )


def _contradicts(shares: dict[VerifiedPair, float]) -> bool:
    """Whether a pose contradicts its pairs; ``shares``: pair -> share of the agreeing matches.

    Pairs of photos that follow each other are also examined on their own: if whole rooms look
    alike, the many false pairs agree with each other.
    """

    def outweighed(pairs: Sequence[VerifiedPair]) -> bool:
        torn = sum(pair.weight**2 for pair in pairs if shares[pair] < _CONTRADICTING)
        return torn > sum(pair.weight**2 for pair in pairs if shares[pair] >= _AGREEING)

    counted = [pair for pair in shares if pair.counts]
    return outweighed(counted) or outweighed([pair for pair in counted if pair.follows])
