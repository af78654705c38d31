"""Every way to build an `Esdf`; each has a file of its own."""

from flysplat.systems.collision.esdf_from_depth import (
    bounds_of_depth_images,
    esdf_from_depth_images,
)
from flysplat.systems.collision.esdf_from_distance_field import esdf_from_distance_field
from flysplat.systems.collision.esdf_from_gaussians import esdf_from_gaussians
from flysplat.systems.collision.esdf_from_occupancy import esdf_from_occupancy
from flysplat.systems.collision.octomap import esdf_from_octomap

__all__ = [
    "bounds_of_depth_images",
    "esdf_from_depth_images",
    "esdf_from_distance_field",
    "esdf_from_gaussians",
    "esdf_from_occupancy",
    "esdf_from_octomap",
]
