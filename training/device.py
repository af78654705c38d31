"""Where tensors live, and whether that is there."""

import importlib.util

import torch


def require_device(device: str) -> None:
    """
    Raises:
        ValueError: unless torch can compute on a device: `cpu`, or `cuda` or `cuda:1`.
    """
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device is {device!r}; it must be cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        built = torch.version.cuda or "the CPU alone"
        raise ValueError(
            f"device is {device!r}, but there is no GPU that this PyTorch, built for {built}, can "
            "use; choose device=cpu, or install a GPU's driver and a PyTorch for it"
        )


def require_renderer(device: str) -> None:
    """
    Raises:
        ValueError: unless Gaussians can be rendered on a device, for which a GPU needs gsplat.
    """
    require_device(device)
    if device.startswith("cuda") and importlib.util.find_spec("gsplat") is None:
        raise ValueError(
            f"device is {device!r}, on which gsplat renders; pip install 'splatpilot[cuda]', or "
            "choose device=cpu"
        )
