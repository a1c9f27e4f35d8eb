"""Registers photos one after the other, in the order of their strongest pairs.

By default, COLMAP next registers a photo that sees many points of the model. If two places look
alike, this may be a photo of the other place. Its pose is then wrong, and so are the poses of the
photos that are registered from it. Here, the next photo is one that follows a registered photo by
name, if there is any; otherwise the photo whose strongest pair with a registered photo has the most
matches. So the model grows as in Prim's algorithm for the maximum spanning tree of the view graph.

The estimation of poses and points and the bundle adjustment are those of COLMAP's incremental
mapper (Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016).
"""

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pycolmap

from snowsplat.sfm.colmap.database import closing_database
from snowsplat.sfm.colmap.mapping.view_graph import ViewGraph

# In degrees. The first two photos are the pair with the largest weight among the pairs whose points
# have a median triangulation angle of at least the first of these angles. If there is no such pair,
# the second angle is used. Only if both fail for the photos that follow each other, other pairs are
# tried. Photos that follow each other often have smaller angles than COLMAP requires (16).
_INITIAL_ANGLES = (8.0, 4.0)
# If pairs of photos that were taken while walking forward are allowed, these angles are used.
_FORWARD_ANGLES = (8.0, 4.0, 2.0)
_INITIAL_PAIRS = 100  # number of pairs that are tried for each angle
_MIN_INITIAL_POINTS = 50
ImagePair = tuple[int, int]


@dataclass
class IncrementalMapper:
    """Makes models from the features and verified matches in a database.

    ``registered`` is called with the model after each photo. ``reduced`` is a copy of the database
    with a part of the matches; photos are registered with these.
    """

    database: Path
    graph: ViewGraph
    options: pycolmap.IncrementalPipelineOptions
    registered: Callable[[pycolmap.Reconstruction], None]
    reduced: Path | None = None
    _tried: set[ImagePair] = field(default_factory=set)  # initial pairs

    def start(self, photos: Collection[int]) -> pycolmap.Reconstruction | None:
        """A new model of two of ``photos`` (image ids); None if there are no two suitable photos.

        Each call starts with a pair of photos with which no earlier call started.
        """
        options = self.options.get_mapper()
        with self._mapper(photos, self.database) as mapper:
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
        graph = self.graph.of_photos({*photos, *model.reg_image_ids()})
        with self._mapper(graph.names, self.reduced or self.database) as mapper:
            mapper.begin_reconstruction(model)
            _Growth(mapper, model, graph, self.options, adjust, self.registered).register_all()
            mapper.end_reconstruction(False)

    def triangulate_all(self, model: pycolmap.Reconstruction, pairs: bool) -> None:
        """Add the points of all matches to ``model``. The poses do not change.

        ``pairs``: also those that only two photos see. COLMAP does not use such matches for poses
        (`ignore_two_view_tracks`), because they contribute little, and more of them are false. With
        the final poses, a false match is recognised: most of them are far from the epipolar line.
        """
        options = self.options.get_triangulation()
        options.ignore_two_view_tracks = not pairs
        photos = sorted(model.reg_image_ids())
        with self._mapper(photos, self.database) as mapper:
            mapper.begin_reconstruction(model)
            for photo in photos:
                mapper.triangulate_image(options, photo)
            if not pairs:
                mapper.complete_and_merge_tracks(options)
            mapper.end_reconstruction(False)

    def _initial_pairs(
        self,
        mapper: pycolmap.IncrementalMapper,
        options: pycolmap.IncrementalMapperOptions,
        photos: Collection[int],
    ) -> Iterator[tuple[ImagePair, pycolmap.Rigid3d]]:
        """Candidates for the first two photos of a model, with their relative poses."""
        pairs = sorted(self.graph.of_photos(photos).pairs, key=lambda pair: -pair.weight)
        forward = options.init_max_forward_motion >= 1
        angles = _FORWARD_ANGLES if forward else _INITIAL_ANGLES
        for follows, angle in itertools.product((True, False), angles):
            options.init_min_tri_angle = angle
            for pair in [pair for pair in pairs if pair.follows is follows][:_INITIAL_PAIRS]:
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
        self, photos: Collection[int], database: Path
    ) -> Iterator[pycolmap.IncrementalMapper]:
        """COLMAP's mapper for ``photos``, with the matches of ``database``."""
        options = pycolmap.DatabaseCacheOptions()
        options.min_num_matches = self.options.min_num_matches
        options.image_names = {self.graph.names[photo] for photo in photos}
        options.load_all_images = True  # a model may contain photos without any match
        with closing_database(database) as source:
            cache = pycolmap.DatabaseCache.create(source, options)
        yield pycolmap.IncrementalMapper(cache)


@dataclass
class _Growth:
    """Registers photos in ``model`` until no further photo can be registered."""

    mapper: pycolmap.IncrementalMapper
    model: pycolmap.Reconstruction
    graph: ViewGraph
    options: pycolmap.IncrementalPipelineOptions
    adjust: bool  # run bundle adjustment
    registered: Callable[[pycolmap.Reconstruction], None]

    def __post_init__(self) -> None:
        self._mapper_options = self.options.get_mapper()
        self._triangulation = self.options.get_triangulation()
        self._size = self._sizes()  # after the last global bundle adjustment

    def register_all(self) -> None:
        while True:
            if self._register_next():
                self.registered(self.model)
                if self.adjust and self._has_grown():
                    self._adjust_all()
            elif self.adjust and self._sizes() != self._size:
                self._adjust_all()
            else:
                break
        if not self.adjust:
            self.mapper.complete_and_merge_tracks(self._triangulation)
            self.mapper.filter_points(self._mapper_options)

    def _register_next(self) -> bool:
        """Register one photo, from points of the model, or else only from its matches."""
        functions = [self.mapper.register_next_image]
        if self.adjust:  # takes up to half a minute for a photo with many false matches
            functions.append(self.mapper.register_next_structure_less_image)
        for structure_less, register in enumerate(functions):
            found = self.mapper.find_next_images(self._mapper_options, bool(structure_less))
            for photo in self._in_order(found):
                if register(self._mapper_options, photo):
                    self.mapper.triangulate_image(self._triangulation, photo)
                    if self.adjust:
                        self.mapper.iterative_local_refinement(
                            self.options.ba_local_max_refinements,
                            self.options.ba_local_max_refinement_change,
                            self._mapper_options,
                            self.options.get_local_bundle_adjustment(),
                            self._triangulation,
                            photo,
                        )
                    return True
        return False

    def _in_order(self, photos: Sequence[int]) -> list[int]:
        """``photos`` in the order in which they are tried."""
        placed = set(self.model.reg_image_ids())

        def rank(photo: int) -> tuple[bool, float, int]:
            pairs = [pair for pair in self.graph.pairs_of[photo] if pair.other(photo) in placed]
            follows = any(pair.follows and pair.counts for pair in pairs)
            return follows, max((pair.weight for pair in pairs), default=0.0), -photo

        return sorted(photos, key=rank, reverse=True)

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
