"""PNG files, whose chunks say how long they are; OpenCV asks memory for what they say."""

import struct
from pathlib import Path

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_AROUND = 12  # [bytes] of a chunk beside its content


def require_whole_chunks(path: Path, content: bytes) -> None:
    """
    Args:
        path: the file, for messages.
        content: of it; what is no PNG passes.

    Raises:
        ValueError: if a chunk is longer than what is left of the file.
    """
    if not content.startswith(_SIGNATURE):
        return
    begin = len(_SIGNATURE)
    while begin + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, begin)
        begin += length + _AROUND
        if begin > len(content):
            raise ValueError(
                f"{path}: a chunk of the PNG claims {length} bytes, more than there are; the file "
                "is damaged, copy it again"
            )
        if kind == b"IEND":
            return
