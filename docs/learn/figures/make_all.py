"""Makes all figures of the course again."""

import blending
import camera
import covariance
import density_control
import gaussian
import gradients
import history
import initialisation
import interactive_space
import interactive_tiles
import ply
import projection
import rasterizer
import reference_walk
import spherical_harmonics
import structure_from_motion
import surfaces

for module in (
    gaussian,
    covariance,
    camera,
    structure_from_motion,
    projection,
    spherical_harmonics,
    blending,
    gradients,
    rasterizer,
    reference_walk,
    initialisation,
    density_control,
    surfaces,
    ply,
    interactive_space,
    interactive_tiles,
    history,
):
    print(module.__name__, flush=True)
    module.main()
