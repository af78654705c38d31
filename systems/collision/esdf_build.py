"""Every way to build an `Esdf`; each has a file of its own."""

from splatpilot.systems.collision.esdf_from_depth import (
    bounds_of_depth_images,
    esdf_from_depth_images,
)
from splatpilot.systems.collision.esdf_from_distance_field import esdf_from_distance_field
from splatpilot.systems.collision.esdf_from_gaussians import esdf_from_gaussians
from splatpilot.systems.collision.esdf_from_occupancy import esdf_from_occupancy
from splatpilot.systems.collision.octomap import esdf_from_octomap

__all__ = [
    "bounds_of_depth_images",
    "esdf_from_depth_images",
    "esdf_from_distance_field",
    "esdf_from_gaussians",
    "esdf_from_occupancy",
    "esdf_from_octomap",
]
