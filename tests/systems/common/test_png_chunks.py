"""What PNG files claim."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpilot.systems.common.readers import require_whole_chunks


def test_claims_of_chunks():
    """A chunk that claims more than the file has is refused, wherever it stands; whole files, what
    stands behind them, and other formats pass."""
    content = cv2.imencode(".png", np.zeros((5, 4, 3), np.uint8))[1].tobytes()
    require_whole_chunks(Path("a.png"), content)
    require_whole_chunks(Path("a.png"), content + b"behind it")
    require_whole_chunks(Path("a.jpg"), b"\xff\xd8\xff\xe0")
    for kind in (b"IHDR", b"IDAT", b"IEND"):
        at = content.index(kind) - 4
        damaged = content[:at] + struct.pack(">I", 0x76967E1C) + content[at + 4 :]
        with pytest.raises(ValueError, match=r"a\.png: a chunk of the PNG claims 1989574172 bytes"):
            require_whole_chunks(Path("a.png"), damaged)
