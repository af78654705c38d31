"""Learned drone flight inside Gaussian-splat reconstructions of real places, as Drake systems."""
