"""Whether the binary files of a COLMAP model are as long as they claim.

pycolmap believes what they say: a count that is wrong makes it take all memory, or loop for ever.
"""

import struct
from collections.abc import Callable
from pathlib import Path

from splatpilot.systems.read_limit import require_readable_size


class _Records:
    """A file that is gone through from its beginning."""

    def __init__(self, file: Path) -> None:
        require_readable_size(file, 4 * file.stat().st_size)  # As objects it takes more.
        self._content = file.read_bytes()
        self._at = 0

    def take(self, form: str) -> tuple:
        """The next numbers, as `struct` describes them."""
        self.skip(size := struct.calcsize("<" + form))
        return struct.unpack_from("<" + form, self._content, self._at - size)

    def skip(self, size: int) -> None:
        if size > len(self._content) - self._at:
            raise ValueError(
                f"byte {self._at} claims {size} more bytes, there are "
                f"{len(self._content) - self._at}"
            )
        self._at += size

    def skip_text(self) -> None:
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise ValueError(f"the text from byte {self._at} does not end")
        self._at = end + 1

    def is_read(self) -> bool:
        return self._at == len(self._content)


def _camera(records: _Records, num_params: Callable[[int], int]) -> None:
    _, model, _, _ = records.take("iiQQ")
    records.skip(8 * num_params(model))


def _image(records: _Records, num_params: Callable[[int], int]) -> None:
    records.take("I7dI")  # number, pose, camera
    records.skip_text()
    records.skip(24 * records.take("Q")[0])


def _point(records: _Records, num_params: Callable[[int], int]) -> None:
    records.take("Q3d3Bd")  # number, place, colour, error
    records.skip(8 * records.take("Q")[0])


def _rig(records: _Records, num_params: Callable[[int], int]) -> None:
    _, sensors = records.take("II")
    if sensors:
        records.take("iI")
    for _ in range(sensors - 1):
        if records.take("iI?")[2]:
            records.skip(7 * 8)


def _frame(records: _Records, num_params: Callable[[int], int]) -> None:
    *_, data = records.take("II7dI")
    records.skip(16 * data)


_FILES = {"cameras": _camera, "images": _image, "points3D": _point, "rigs": _rig, "frames": _frame}


def check_records(model: Path, num_params: Callable[[int], int]) -> None:
    """Goes through the binary files of a model.

    Args:
        model: its folder.
        num_params: how many numbers describe a camera of the model with this number.

    Raises:
        ValueError: if one is cut short, longer than it claims or too large; the message names it.
    """
    for name, skip in _FILES.items():
        file = model / f"{name}.bin"
        if not file.is_file():
            continue
        records = _Records(file)
        try:
            (count,) = records.take("Q")
            for _ in range(count):
                skip(records, num_params)
            if not records.is_read():
                raise ValueError("more follows the last record")
        except ValueError as error:
            raise ValueError(f"{file} is damaged: {error}; copy it again") from None
