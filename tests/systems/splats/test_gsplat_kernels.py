"""gsplat's results in the shapes of ours; a stand-in for gsplat 1.5.3 takes and gives what it does.

What its kernels compute is compared with ours on a GPU, by `benchmarks/agreement.py`.
"""

import types
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from splatpilot.systems.splats import rasterization as gsplat_kernels

C, N, H, W = 2, 5, 4, 6
IMAGE, ALPHA = torch.rand(C, H, W, 4), torch.rand(C, H, W, 1)
NORMALS = torch.nn.functional.normalize(torch.rand(C, N, 3), dim=2)
RADII = torch.tensor([[[3, 3], [0, 2], [1, 1], [0, 0], [2, 0]]] * C, dtype=torch.int32)
R_CW = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def scene() -> tuple[torch.Tensor, ...]:
    viewmats = torch.eye(4).repeat(C, 1, 1)
    viewmats[:, :3, :3] = R_CW
    return (
        torch.rand(N, 3), torch.rand(N, 4), torch.rand(N, 3), torch.rand(N), torch.rand(N, 3),
        viewmats,
    )  # fmt: skip


def stand_in(given: dict[str, Any]) -> types.SimpleNamespace:
    def rasterization(*arguments, **options):
        given.update(options)
        return IMAGE, ALPHA, {"gaussian_ids": torch.arange(N)}

    def rasterization_2dgs(_means, _quats, _scales, opacities, colors, viewmats, *_, **options):
        given.update(options)
        cameras = len(viewmats)
        # As it joins depths (C, N, 1) to them.
        assert colors.shape == (cameras, N, 3)
        meta = {
            "radii": RADII[:cameras], "depths": torch.rand(cameras, N),
            "opacities": opacities.expand(cameras, N), "means2d": torch.rand(cameras, N, 2),
            "normals": NORMALS[:cameras], "camera_ids": None, "gaussian_ids": None,
        }  # fmt: skip
        image, alpha = IMAGE[:cameras], ALPHA[:cameras]
        normals = image[..., :3]
        return image, alpha, normals, normals.squeeze(0), alpha, alpha, meta

    return types.SimpleNamespace(rasterization=rasterization, rasterization_2dgs=rasterization_2dgs)


@pytest.fixture
def given(monkeypatch) -> dict[str, Any]:
    """What gsplat was last asked for by name."""
    asked: dict[str, Any] = {}
    monkeypatch.setattr(gsplat_kernels, "import_extra", lambda *_: stand_in(asked))
    return asked


@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
def test_backgrounds_shine_through_colours_and_never_reach_gsplat(given, render_mode):
    backgrounds = torch.rand(C, 3)
    image, alpha, _ = gsplat_kernels.rasterize_by_gsplat(
        scene(), torch.eye(3).repeat(C, 1, 1), W, H, backgrounds=backgrounds,
        render_mode=render_mode,
    )  # fmt: skip
    assert "backgrounds" not in given
    assert_close(image[..., :3], IMAGE[..., :3] + (1 - alpha) * backgrounds[:, None, None])
    assert_close(image[..., 3], IMAGE[..., 3])


def test_surfels_are_told_by_pair_with_their_normals_in_the_world(given):
    """Those of no extent in one direction are not seen; a normal of a camera that looks along x is
    turned into the world."""
    options = {"sh_degree": None, "render_mode": "RGB+ED", "backgrounds": None}
    K = torch.eye(3).repeat(C, 1, 1)
    meta = gsplat_kernels.rasterize_surfels_by_gsplat(scene(), K, W, H, **options)[-1]
    assert meta["gaussian_ids"].tolist() == [0, 2, 0, 2]
    assert meta["camera_ids"].tolist() == [0, 0, 1, 1]
    assert [len(meta[n]) for n in ("depths", "opacities", "radii", "means2d")] == [4] * 4
    assert_close(meta["normals"], NORMALS[:, [0, 2]].flatten(0, 1) @ R_CW)


def test_normals_of_one_camera_have_its_dimension(given):
    *splats, viewmats = scene()
    surface = gsplat_kernels.rasterize_surfels_by_gsplat(
        (*splats, viewmats[:1]), torch.eye(3)[None], W, H, sh_degree=None, render_mode="RGB+ED",
        backgrounds=None,
    )[3]  # fmt: skip
    assert surface is not None and surface.shape == (1, H, W, 3)
