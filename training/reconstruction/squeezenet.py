"""The layers of SqueezeNet 1.1 (Iandola et al. 2016) below its classifier.

They are torchvision's in order and names, so that its weights fit. Importing torchvision takes
seconds and loads Triton, whose LLVM ends the process where that of Mesa's OpenGL is there already.
"""

import torch
from torch import Tensor, nn


class Fire(nn.Module):
    """A 1x1 convolution that narrows, then 1x1 and 3x3 ones beside each other that widen."""

    def __init__(self, inputs: int, narrow: int, wide: int):
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, narrow, 1)
        self.expand1x1 = nn.Conv2d(narrow, wide, 1)
        self.expand3x3 = nn.Conv2d(narrow, wide, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def squeezenet_features() -> nn.Sequential:
    """The layers, with weights that nobody has trained: (N, 3, H, W) to (N, 512, h, w)."""

    def smaller() -> nn.MaxPool2d:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    return nn.Sequential(
        *(nn.Conv2d(3, 64, 3, 2), nn.ReLU(), smaller()),
        *(Fire(64, 16, 64), Fire(128, 16, 64), smaller()),
        *(Fire(128, 32, 128), Fire(256, 32, 128), smaller()),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    )
