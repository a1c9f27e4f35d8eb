"""Estimates camera poses and points from matches, and removes unreliable poses and points."""

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from snowsplat.sfm.colmap.database import (
    MIN_INLIERS,
    closing_database,
    copy_for_mapping,
    keep_matches_of_long_tracks,
    remove_database,
)
from snowsplat.sfm.colmap.features.alignment import align_features
from snowsplat.sfm.colmap.features.extraction import SEED
from snowsplat.sfm.colmap.lenses.lens import TOLERANCE, robust_adjustment
from snowsplat.sfm.colmap.lenses.posterior import estimate_lenses
from snowsplat.sfm.colmap.mapping.incremental import IncrementalMapper
from snowsplat.sfm.colmap.mapping.view_graph import ViewGraph, spread_subset
from snowsplat.sfm.colmap.options import photos_with_adjustment
from snowsplat.sfm.options import MIN_PHOTOS, Mapper
from snowsplat.sfm.progress import Report
from snowsplat.util.files import new_entries, new_folder

# The alignment of features reduces their errors to a third; then fewer points than `MIN_INLIERS`
# tell a pose.
_MIN_POINTS_ALIGNED = 10
# At the end, observations with a larger reprojection error are removed. In pixels of the resized
# photo in which the features were detected.
_MAX_REPROJECTION_ERROR = 3.0
_MAX_MODELS = 20  # a model is started at most this number of times
# A model is small if it has fewer photos than this, and than this share of the photos that are in
# no model (as COLMAP's min_model_size, and its condition for few photos).
_SMALL_MODEL, _LARGE_SHARE = 10, 0.8
# With at least this number of photos, global bundle adjustment runs less often: when the model has
# grown by 40% (default of COLMAP: 10%). It then runs once (default of COLMAP: up to 5 times), with
# at most 20 iterations. Local bundle adjustment runs after each new photo, as with fewer photos.
_LARGE_MODEL = 40
_GROWTH = 1.4
_ITERATIONS = 20
# Bundle adjustment ends when an iteration reduces the cost by less than this share. There is one
# share for local and one for global bundle adjustment in the mapper, and two for that of a result,
# before the last scale of its loss and with it. The alignment of features moves cameras by little,
# so larger shares suffice after it: the centres are the same within 0.005% of the extent. By
# default, COLMAP goes on until the gradient is small, which takes several times as long.
_GLOBAL_TOLERANCE = 1e-5
_EARLY_TOLERANCE = 1e-3
_ALIGNED_TOLERANCES = (1e-2, 1e-3)
# The bundle adjustment of the result has a Cauchy loss, so false matches that became observations
# have little effect on the poses. Its scale, in units of the mean reprojection error, is decreased:
# with the small one alone, a model that is bent may remain bent. Before the check of the poses, the
# first scale is sufficient.
_FINAL_LOSS_SCALES = (3.0, 1.0)
_FIRST_LOSS_SCALES = (3.0,)
# In degrees: smallest triangulation angle of a point; the second one for `Mapping.forward`.
_MIN_ANGLE, _MIN_FORWARD_ANGLE = 1.5, 0.7
# For `Mapping.forward`: a photo is registered with this number of points (default of COLMAP: 30).
_FORWARD_INLIERS = 20


@dataclass(frozen=True)
class Mapping:
    """The inputs and resources of the mapper."""

    database: Path
    images: Path
    scale: float  # size of a photo / size at which its features were detected (1 or more)
    threads: int
    report: Report
    held: bool = False  # the focal lengths are not changed
    # The photos may have been taken while walking forward. Then the points ahead have small angles,
    # and few of them are in several photos.
    forward: bool = False
    show_poses: Callable[[pycolmap.Reconstruction, bool], None] = lambda model, now: None

    def run(self, mapper: Mapper) -> list[pycolmap.Reconstruction]:
        """Estimate poses and points; returns the models, the one with the most photos first."""
        models = self._map_incrementally() if mapper == "incremental" else self._map_globally()
        return usable_models([self._refine(m, scales=_FIRST_LOSS_SCALES) for m in models])

    def extend(
        self, models: list[pycolmap.Reconstruction], relaxed: bool = True
    ) -> list[pycolmap.Reconstruction]:
        """Try to add photos to the first of ``models``, and return all models.

        Photos of the other models are tried, too, so that separate models may be joined. If no
        photo can be added, ``models`` are returned unchanged.

        ``relaxed``: accept weaker matches than COLMAP does by default.
        """
        before = models[0].num_reg_images()
        model = copy.deepcopy(models[0])
        graph = ViewGraph.read(self.database)
        self._grow(self._mapper(graph, relaxed), model, graph, self._first(graph))
        if model.num_reg_images() <= before or self._refine(model).num_reg_images() <= before:
            return models
        return usable_models([model, *models[1:]])

    def without(
        self, model: pycolmap.Reconstruction, photos: Iterable[int]
    ) -> pycolmap.Reconstruction:
        """Remove the poses of ``photos`` (image ids) from ``model``, and run bundle adjustment.

        Changes ``model`` and returns it.
        """
        observations = pycolmap.ObservationManager(model)
        for image_id in sorted(photos):
            observations.deregister_frame(model.image(image_id).frame_id)
        return self._refine(model)

    def with_cameras(
        self, model: pycolmap.Reconstruction, cameras: Sequence[pycolmap.Camera], held: bool
    ) -> pycolmap.Reconstruction:
        """A copy of ``model`` with other cameras, those with the same ids, after bundle adjustment.

        ``held``: the focal lengths are not changed.
        """
        model, mapping = copy.deepcopy(model), replace(self, held=held)
        for camera in cameras:
            if camera.camera_id in model.cameras:
                old = model.cameras[camera.camera_id]
                old.model, old.params = camera.model, list(camera.params)
        if cameras:  # with other cameras, correct observations have large errors at first
            model.update_point_3d_errors()
            mapping._adjust(model, _FINAL_LOSS_SCALES[0])
            model.update_point_3d_errors()
        return mapping._refine(model)

    def complete(
        self, model: pycolmap.Reconstruction, image_size: int, exif: dict[int, float]
    ) -> pycolmap.Reconstruction:
        """The final poses, lenses and points of ``model``, which may be changed.

        The features of each point are aligned, and the lenses are estimated with their priors.

        Args:
            image_size: the longest side of the photos in which the features were detected.
            exif: as in `with_likely_lenses`.
        """
        align_features(model, self.database, self.images, image_size, self.threads)
        self._refine(model, _MIN_POINTS_ALIGNED, tolerances=_ALIGNED_TOLERANCES)
        model = self.with_likely_lenses(model, exif)
        self._remove_outliers(model, _MIN_POINTS_ALIGNED)
        self._add_points(model)
        return model

    def with_likely_lenses(
        self, model: pycolmap.Reconstruction, exif: dict[int, float]
    ) -> pycolmap.Reconstruction:
        """`estimate_lenses`; focal lengths that are held are not contradicted by the photos."""
        return estimate_lenses(model, exif, self.held, self.threads)

    def _add_points(self, model: pycolmap.Reconstruction) -> None:
        """Add points that only two photos of ``model`` see, for the training. Changes ``model``."""
        with closing_database(self.database) as database:  # they may have another camera model now
            for camera in model.cameras.values():
                database.update_camera(camera)
        mapper = self._mapper(ViewGraph.read(self.database))
        mapper.triangulate_all(model, pairs=True)
        self._remove_outliers(model, _MIN_POINTS_ALIGNED)

    def _options(self, relaxed: bool) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions()
        # With several threads, the result of COLMAP's mapper depends on their timing.
        options.num_threads = 1
        with closing_database(self.database) as database:
            photos = database.num_images()
        if photos >= _LARGE_MODEL:
            options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
            options.ba_global_max_refinements = 1
            options.ba_global_max_num_iterations = _ITERATIONS
        options.ba_global_function_tolerance = _GLOBAL_TOLERANCE
        options.ba_local_function_tolerance = TOLERANCE
        options.ba_local_max_refinements = 1
        options.random_seed = SEED
        mapper, triangulation = options.mapper, options.triangulation
        mapper.init_max_error *= self.scale
        mapper.abs_pose_max_error *= self.scale
        mapper.filter_max_reproj_error *= self.scale
        triangulation.merge_max_reproj_error *= self.scale
        triangulation.complete_max_reproj_error *= self.scale
        options.ba_refine_focal_length = not self.held
        if self.forward:
            mapper.init_max_forward_motion = 1.0
            mapper.filter_min_tri_angle = triangulation.min_angle = self._min_angle
            mapper.abs_pose_min_num_inliers = _FORWARD_INLIERS
        if relaxed:
            options.min_num_matches = 10
            mapper.init_min_num_inliers = 40
            mapper.init_min_tri_angle = 6.0
            mapper.abs_pose_min_num_inliers = MIN_INLIERS
            mapper.abs_pose_min_inlier_ratio = 0.15
            mapper.max_reg_trials = 6
        return options

    @property
    def _min_angle(self) -> float:
        return _MIN_FORWARD_ANGLE if self.forward else _MIN_ANGLE

    def _map_incrementally(self) -> list[pycolmap.Reconstruction]:
        """Make models one after the other, each from the photos that are in no earlier model.

        A small model may be the result of an unsuitable first pair, so its photos remain available:
        they may connect the two halves of a large one. No model starts with them again.
        """
        graph = ViewGraph.read(self.database)
        models: list[pycolmap.Reconstruction] = []
        left, in_small = graph, set[int]()
        # Of a walk forward, few points are in several photos, so no match can be spared.
        with nullcontext() if self.forward else self._long_tracks() as reduced:
            mapper = self._mapper(graph, reduced=reduced)
            for _ in range(_MAX_MODELS):
                first = self._first(left)
                enough = len(left.names) >= MIN_PHOTOS
                model = mapper.start(first - in_small) if enough else None
                if model is None:
                    break
                self._grow(mapper, model, left, first)
                if model.num_reg_images() < MIN_PHOTOS:
                    continue
                models.append(model)
                photos = set(model.reg_image_ids())
                if len(photos) < min(_SMALL_MODEL, _LARGE_SHARE * len(left.names)):
                    in_small |= photos
                else:
                    left = left.of_photos(set(left.names) - photos)
        models = usable_models(models)
        if reduced is not None:
            for model in models:
                mapper.triangulate_all(model, pairs=False)
        return models

    @contextmanager
    def _long_tracks(self) -> Iterator[Path]:
        """A temporary copy of the database that has only the matches of long tracks."""
        reduced = self.database.with_suffix(".tracks.db")
        try:
            copy_for_mapping(self.database, reduced, without=())
            keep_matches_of_long_tracks(reduced)
            yield reduced
        finally:
            remove_database(reduced)

    def _mapper(
        self, graph: ViewGraph, relaxed: bool = False, reduced: Path | None = None
    ) -> IncrementalMapper:
        def registered(model: pycolmap.Reconstruction) -> None:
            self.report(model.num_reg_images(), len(graph.names), "registered photos")
            self.show_poses(model, False)

        return IncrementalMapper(self.database, graph, self._options(relaxed), registered, reduced)

    def _first(self, graph: ViewGraph) -> set[int]:
        """The photos (image ids) that are registered with bundle adjustment."""
        return spread_subset(graph, photos_with_adjustment(len(graph.names)))

    def _grow(
        self,
        mapper: IncrementalMapper,
        model: pycolmap.Reconstruction,
        graph: ViewGraph,
        first: set[int],
    ) -> None:
        """Register the photos of ``graph`` in ``model``, those of ``first`` before the others."""
        mapper.grow(model, first, adjust=True)
        if len(first) < len(graph.names):
            mapper.grow(model, graph.names, adjust=False)

    def _map_globally(self) -> list[pycolmap.Reconstruction]:
        options = pycolmap.GlobalPipelineOptions()
        for threaded in (options, options.mapper):
            threaded.num_threads = self.threads
            threaded.random_seed = SEED
        options.mapper.max_normalized_reproj_error *= self.scale
        options.min_model_size = MIN_PHOTOS
        self.report(0, 0, "registered photos")
        # COLMAP writes each model there as soon as it is complete.
        with new_folder(self.database.with_suffix(".models")) as output:
            made = pycolmap.global_mapping(self.database, self.images, output, options)
        return list(made.values())

    def _refine(
        self,
        model: pycolmap.Reconstruction,
        min_points: int = MIN_INLIERS,
        scales: Sequence[float] = _FINAL_LOSS_SCALES,
        tolerances: tuple[float, float] = (_EARLY_TOLERANCE, TOLERANCE),
    ) -> pycolmap.Reconstruction:
        """Remove outliers and run bundle adjustment, for each of ``scales`` of the loss. Changes
        ``model`` and returns it. ``min_points`` as in `_remove_outliers`;
        ``tolerances``: before the last scale, and with it."""
        self._remove_outliers(model, min_points)
        for scale in scales:
            if model.num_reg_images() < MIN_PHOTOS:
                break
            last = scale == _FINAL_LOSS_SCALES[-1]
            self._adjust(model, scale, tolerances[last])
            self._remove_outliers(model, min_points)
        return model

    def _adjust(
        self, model: pycolmap.Reconstruction, scale: float, tolerance: float = TOLERANCE
    ) -> None:
        """Run bundle adjustment; ``scale`` of the loss, in units of the mean reprojection error."""
        scale *= model.compute_mean_reprojection_error()
        options = robust_adjustment(self.threads, tolerance, scale)
        options.refine_focal_length = not self.held
        pycolmap.bundle_adjustment(model, options)

    def _remove_outliers(self, model: pycolmap.Reconstruction, min_points: int) -> None:
        """Remove observations with a large error, flat points, and cameras with few points. A
        camera remains if it sees at least ``min_points`` points."""
        observations = pycolmap.ObservationManager(model)
        observations.filter_all_points3D(_MAX_REPROJECTION_ERROR * self.scale, self._min_angle)
        for image_id in list(model.reg_image_ids()):
            image = model.image(image_id)
            if image.num_points3D < min_points:
                observations.deregister_frame(image.frame_id)
        model.update_point_3d_errors()


def usable_models(models: list[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    """``models``, the one with the most photos first.

    Models with fewer than `MIN_PHOTOS` photos, and those whose photos are all in larger models, are
    left out.
    """
    kept: list[pycolmap.Reconstruction] = []
    covered: set[int] = set()
    for model in sorted(models, key=lambda m: (-m.num_reg_images(), -m.num_points3D())):
        photos = set(model.reg_image_ids())
        if len(photos) >= MIN_PHOTOS and photos - covered:
            kept.append(model)
            covered |= photos
    return kept


def write_models(models: list[pycolmap.Reconstruction], sparse: Path) -> None:
    """Write the models as ``sparse/0``, ``sparse/1`` …; replaces the whole folder."""
    with new_entries(sparse.parent, [sparse.name]) as new:
        for number, model in enumerate(models):
            folder = new / sparse.name / str(number)
            folder.mkdir(parents=True)
            model.write(folder)
